"""Review of cleaned takes in the browser: decisions on their changes, corrections, and cleaning them again.

- `server`: the server of the page
- `review_session`: the takes of a folder under review, and their cleaning
- `apply_decisions`: the stage after the fill: which changes are applied, also without a review
- `take_files`: the cleaned takes in a folder: their decisions and approvals, and what the page shows of them
"""
