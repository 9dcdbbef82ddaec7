"""The command as a process: python -m mocapfix, or mocapfix."""

import gc
import os


def main() -> None:
    """Run the command line, BLAS on one thread, and without collecting garbage, neither while it runs nor when it ends.

    The matrices are small, and the frames are what is shared out among the cores: BLAS's own threads would only wait for
    each other, for seconds where the machine is busy. It reads this when it is loaded, so before anything is imported.
    Libraries are a million objects that live as long as the process, and a take's arrays go with their last reference:
    looking through them all for cycles costs half a second of a short run, and finds nothing.
    """
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    gc.disable()
    from mocapfix.cli import app

    try:
        app.run_command_line()
    finally:
        gc.freeze()


if __name__ == "__main__":
    main()
