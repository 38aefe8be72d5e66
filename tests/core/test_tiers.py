"""What is left to ``make thorough`` is there: a name that fits no test would leave out nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.core.tiers import THOROUGH

HERE = Path(__file__).parent


def test_every_name_is_that_of_a_test() -> None:
    files = [str(HERE / file) for file in THOROUGH]
    command = [sys.executable, "-m", "pytest", "--collect-only", "-m", "thorough", *files]
    listed = subprocess.run(
        command, check=True, capture_output=True, text=True, cwd=HERE.parents[1]
    ).stdout.splitlines()
    for file, names in THOROUGH.items():
        of_file = [line for line in listed if line.startswith(f"tests/core/{file}::")]
        assert [name for name in names if not any(name in line for line in of_file)] == [], file
