"""Where the scenes lie that studies share and the repository does not hold."""

from pathlib import Path

SUPPLIED = Path(__file__).parents[3] / "shared" / "scenes"
