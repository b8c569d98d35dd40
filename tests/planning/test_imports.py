"""Planning needs numpy, the physics and a posterior file, and loads nothing of the samplers."""

import subprocess
import sys

#: Modules that a plan does not need.
HEAVY = ("pymc", "pytensor", "arviz", "matplotlib")
#: Modules of the package that planning may load.
MOST = 96


def test_planning_loads_no_sampler() -> None:
    script = (
        "import sys\nfrom pbrl_ppl.planning import ActionSet, Goal, plan\n"
        f"print(*sorted({{m.split('.')[0] for m in sys.modules}} & set({HEAVY!r})))\n"
        "print(sum(m.startswith('pbrl_ppl') for m in sys.modules))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    )
    heavy, count = done.stdout.split("\n")[:2]
    assert heavy == ""
    assert int(count) < MOST
