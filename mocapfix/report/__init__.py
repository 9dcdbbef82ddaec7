"""Reports on a cleaned take: the JSON and HTML reports, the review file, the notes and the rerun recording."""
