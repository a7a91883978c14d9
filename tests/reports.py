"""Reports that tests make are held against the published schema."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jsonschema

from lipac.core.files.report import Report
from lipac.core.files.report_schema import schema

_VALIDATOR = jsonschema.Draft202012Validator(schema(strict=True))


def check_report(folder: Path) -> None:
    """Whether folder/report.json has what the schema names, and nothing else."""
    data = json.loads((folder / "report.json").read_text())
    problems = [f"{'/'.join(map(str, error.absolute_path))}: {error.message}" for error in _VALIDATOR.iter_errors(data)]
    assert not problems, problems


@contextmanager
def checked_reports() -> Iterator[None]:
    """Have each report checked that is written in this process."""
    write = Report.write

    def checked(self: Report, folder: Path) -> None:
        write(self, folder)
        check_report(folder)

    Report.write = checked  # type: ignore[method-assign]
    try:
        yield
    finally:
        Report.write = write  # type: ignore[method-assign]
