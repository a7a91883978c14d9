"""Pages of docs/ that are written from the code: `python -m lipac.scripts.dev.pages`, or `make docs`, writes all."""
