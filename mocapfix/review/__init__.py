"""Review of cleaned takes in the browser: decisions on their changes, corrections, and cleaning them again."""
