"""Review of cleaned takes in the browser: decisions on their changes, corrections, and cleaning them again.

- `server`: the server of the page
- `review_session`: the takes of a folder under review, and their cleaning
- `apply_decisions`: the stage after the fill: which changes are applied, also without a review
- `edits`: the edits of a changes file, saved at once and undone by what they changed
- `take_files`: the cleaned takes in a folder: their approvals, and what the page shows of them
"""
