"""Batches: the takes of a session, cleaned by the workers of a Dask cluster, with one record file for each take."""
