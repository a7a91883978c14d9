"""Pages that are written from the code, all of them: `python -m lipac.scripts.dev.pages`, or `make docs`."""

from __future__ import annotations

import sys

from .. import diagrams
from . import api_page, architecture_page, reference_page, supported_page


def main() -> int:
    """Write them; returns the exit status."""
    api_page.PAGE.write_text(api_page.page())
    return max(page.main() for page in (architecture_page, reference_page, supported_page, diagrams))


if __name__ == "__main__":
    sys.exit(main())
