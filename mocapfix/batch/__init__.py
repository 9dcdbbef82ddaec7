"""Batches: the takes of a session, cleaned by the workers of a Dask cluster, with one record file for each take.

- `run_session`: the stages of a session, each as jobs on a cluster, and what is resumed
- `job_files`: the takes: folders, patterns, job and session files, with the options with which they are cleaned
- `cluster`: the Dask cluster and the tasks on it; child_process, one job with limits of time and memory
- `jobs`: what a child does: clean a take, and measure what its record and the session page say of each subject
- `records`: what was cleaned, with what, and how it ended
- `session_page`: the page of a session and its tables
"""
