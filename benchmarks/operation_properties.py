"""Random bad arguments for every property of the suite: `operation.py --only properties`.

The suite's modules `tests/*/test_*properties*.py` hold the properties, each a test that Hypothesis feeds; the
suite itself always takes the same few examples, here `--seed` draws others, and more of them. A property that
fails is a wrong answer ("silent") where its assertion fails, else another error than the package's ("raw").
"""

import importlib
import sys
import tempfile
from pathlib import Path

from operation_calls import forked
from operation_cases import Case

ROOT = Path(__file__).parents[1]
_EXAMPLES, _QUICK = 400, 10  # of each property
_SECONDS = 300
_TRIALS = 2  # seeds for each property
_LARGEST = 1000  # characters of what a child says


def cases(quick, seed):
    """Every property with a few seeds, each in a child of its own."""
    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as folder:
        for module, name in properties():
            for trial in range(1 if quick else _TRIALS):
                examples = _QUICK if quick else _EXAMPLES // _TRIALS
                case = seed * _TRIALS + trial

                def fed(module=module, name=name, examples=examples, case=case):
                    return _fed(module, name, examples, case)

                found, ended = forked(fed, folder, _SECONDS)
                where = f"{module.split('.')[1]}: {name}, {examples} examples of seed {case}"
                yield Case("properties", where, *(found or ended))


def properties():
    """Modules and names of all properties."""
    for file in sorted(ROOT.glob("tests/*/test_*properties*.py")):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found = importlib.import_module(module)
        yield from ((module, n) for n, f in vars(found).items() if hasattr(f, "hypothesis"))


def _fed(module, name, examples, case):
    from hypothesis import HealthCheck, Phase, settings

    test = getattr(importlib.import_module(module), name)
    test._hypothesis_internal_use_settings = settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=False,
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
        phases=[Phase.generate],
        print_blob=False,
    )
    test._hypothesis_internal_use_seed = case
    try:
        test()
    except AssertionError as e:
        return "silent", str(e)[:_LARGEST].replace("\n", " ")
    except Exception as e:
        return "raw", f"{type(e).__name__}: {e}"[:_LARGEST].replace("\n", " ")
    return "right", ""
