"""The commands `mocapfix bench ...` by name."""

from mocapfix.cli.bench import (
    run_bench_animations,
    run_bench_baseline,
    run_bench_calibration,
    run_bench_clean,
    run_bench_faults,
    run_bench_files,
    run_bench_solver,
    run_bench_uncertainty,
)
from mocapfix.cli.bench_batch import BATCH_BENCH_COMMANDS
from mocapfix.cli.bench_contacts import run_bench_contacts
from mocapfix.cli.bench_conventions import run_bench_conventions
from mocapfix.cli.bench_fuzz import run_bench_fuzz
from mocapfix.cli.bench_labels import run_bench_labels
from mocapfix.cli.bench_learned_ik import run_bench_learned_ik
from mocapfix.cli.bench_papers import run_bench_hands, run_bench_hybrik, run_bench_prior
from mocapfix.cli.bench_prior_scope import run_bench_prior_scope
from mocapfix.cli.bench_retarget import run_bench_retarget
from mocapfix.cli.bench_review import run_bench_review
from mocapfix.cli.bench_session import run_bench_session
from mocapfix.cli.bench_stress import run_bench_stress

BENCH_COMMANDS = {
    "baseline": run_bench_baseline,
    **BATCH_BENCH_COMMANDS,
    "clean": run_bench_clean,
    "solver": run_bench_solver,
    "uncertainty": run_bench_uncertainty,
    "calibration": run_bench_calibration,
    "review": run_bench_review,
    "stress": run_bench_stress,
    "faults": run_bench_faults,
    "labels": run_bench_labels,
    "fuzz": run_bench_fuzz,
    "files": run_bench_files,
    "animations": run_bench_animations,
    "hybrik": run_bench_hybrik,
    "prior": run_bench_prior,
    "prior-scope": run_bench_prior_scope,
    "retarget": run_bench_retarget,
    "session": run_bench_session,
    "contacts": run_bench_contacts,
    "conventions": run_bench_conventions,
    "hands": run_bench_hands,
    "learned-ik": run_bench_learned_ik,
}
