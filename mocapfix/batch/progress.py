"""What a batch reports while it runs: its stages, the jobs that begin and end, and messages."""


class BatchProgress:
    """Receiver of a batch's progress. This one ignores everything; the command line draws it.

    The stages follow one another, and each has jobs: takes to survey, people to calibrate, takes to clean. A job that is repeated
    on another worker may begin several times; it ends once.
    """

    def start_stage(self, stage: str, job_count: int, done_count: int = 0) -> None:
        """Begin a stage such as "clean", of which `done_count` of the `job_count` jobs were done by an earlier batch."""

    def start_job(self, name: str) -> None:
        """Report that a job was handed to a worker. `name` is the id of the take, or the name of the person."""

    def finish_job(self, name: str, error: str = "") -> None:
        """Report that a job ended, and the sentence on its failure; "" if it is done."""

    def show_dashboard(self, address: str) -> None:
        """Show the address of Dask's dashboard."""

    def show_message(self, message: str) -> None:
        """Show a sentence on the batch, for example that a worker was lost."""
