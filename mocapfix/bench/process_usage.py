"""Run a command in a process and measure its duration, processor time and peak memory.

The command is started by a small process in between, which is this file run as a script: a process that is started by a large
one inherits that one's peak memory. This file therefore imports the standard library only.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

KIB_PER_MIB = 1024
BYTES_PER_MIB = 1024 * 1024
MAX_QUOTED_OUTPUT = 2000  # characters of a failed command's output that its error quotes


class ProcessUsage(NamedTuple):
    """What a command used until it ended.

    duration_s   by the clock
    cpu_s        processor time of all threads, in the program and in the system
    peak_mb      largest resident memory, MiB
    """

    duration_s: float
    cpu_s: float
    peak_mb: float


def run_measured(command: Sequence[str], environment: Mapping[str, str]) -> ProcessUsage:
    """Run a command without input and return what it used.

    Raises RuntimeError with the end of its output if it fails.
    """
    launcher = [sys.executable, "-I", "-S", __file__, *command]
    ran = subprocess.run(launcher, env=dict(environment), stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise RuntimeError(f"{' '.join(command)}: status {ran.returncode}\n{ran.stderr[-MAX_QUOTED_OUTPUT:]}")
    return ProcessUsage(**json.loads(ran.stdout))


def measure_command(command: Sequence[str]) -> tuple[int, ProcessUsage]:
    """Run a command, with its output sent to standard error; return its exit status and what it used."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=sys.stderr)
    _, wait_status, usage = os.wait4(process.pid, 0)
    duration_s = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(wait_status)
    unit_per_mib = BYTES_PER_MIB if sys.platform == "darwin" else KIB_PER_MIB  # of ru_maxrss
    return process.returncode, ProcessUsage(duration_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / unit_per_mib)


def print_usage() -> None:
    """Run the command in this script's arguments and print what it used as JSON."""
    status, usage = measure_command(sys.argv[1:])
    if status:
        sys.exit(status if status > 0 else 1)
    sys.stdout.write(json.dumps(usage._asdict()))


if __name__ == "__main__":
    print_usage()
