"""How often each diagnosis is given where its cause is, and is not where it is not.

    python -m tests.benchmarks.diagnoses [--only KEY] [--seeds N] [--verbose]

The cases are those of tests/reference/diagnoses.py and further_diagnoses.py: ten with the cause of
each diagnosis, and ten without. Printed are the counts and the seeds that fail; an exception that
is none of rankone's is a failure.
"""

from __future__ import annotations

import argparse
import re
import time
import warnings

from tests.reference.diagnoses import diagnoses
from tests.reference.further_diagnoses import further_diagnoses


def outcome(case, seed, pattern):
    """Whether a case is diagnosed, None for a raw exception, and what was said."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            text = case(seed)
    except Exception as error:  # a failure of its own, which the table names
        return None, f"{type(error).__name__}: {error}"
    return re.search(pattern, text) is not None, text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--verbose", action="store_true")
    chosen = parser.parse_args()
    right = wanted = 0
    for diagnosis in [*diagnoses(), *further_diagnoses()]:
        if chosen.only not in diagnosis.key:
            continue
        begin, texts, parts = time.process_time(), [], []
        for cause, case in ((True, diagnosis.present), (False, diagnosis.absent)):
            failing = []
            for seed in range(chosen.seeds):
                found, text = outcome(case, seed, diagnosis.pattern)
                if found is not cause:
                    failing.append(f"{seed}!" if found is None else str(seed))
                    texts.append(f"    {'present' if cause else 'absent'} {seed}: {text}")
            good = chosen.seeds - len(failing)
            right, wanted = right + good, wanted + chosen.seeds
            seeds = f" (not {', '.join(failing)})" if failing else ""
            parts.append(f"{'present' if cause else 'absent'} {good} of {chosen.seeds}{seeds}")
        each = 1e3 * (time.process_time() - begin) / (2 * chosen.seeds)
        print(f"{diagnosis.key:28} {'; '.join(parts)}; {each:.0f} ms each", flush=True)
        if chosen.verbose:
            print("\n".join(text[:600] for text in texts), flush=True)
    print(f"{right} of {wanted} cases are right")


if __name__ == "__main__":
    main()
