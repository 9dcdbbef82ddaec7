"""The command as a process: python -m mocapfix, or mocapfix."""

import gc


def main() -> None:
    """Run the command line without collecting garbage, neither while it runs nor when it ends.

    Libraries are a million objects that live as long as the process, and a take's arrays go with their last reference:
    looking through them all for cycles costs half a second of a short run, and finds nothing.
    """
    gc.disable()
    from mocapfix import cli

    try:
        cli.main()
    finally:
        gc.freeze()


if __name__ == "__main__":
    main()
