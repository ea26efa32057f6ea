"""Build the documentation without the network: `python docs/build.py` writes docs/_build/html; warnings are errors.

Options after it are those of `sphinx-build`.
"""

import re
import sys
from pathlib import Path

from sphinx.cmd.build import main

DOCS = Path(__file__).parent
HTML = DOCS / "_build" / "html"
# What a browser fetches by itself when it shows a page.
FETCHED = re.compile(
    r"""<(?:script|img|iframe|link(?=[^>]*rel="(?:stylesheet|preload|icon)"))[^>]*(?:src|href)="(https?:)?//"""
)


def foreign_requests():
    """Pages that would ask another host for something."""
    return [page.name for page in HTML.rglob("*.html") if FETCHED.search(page.read_text(encoding="utf-8"))]


if __name__ == "__main__":
    failed = main(["-W", "--keep-going", "-q", "-b", "html", *sys.argv[1:], str(DOCS), str(HTML)])
    if foreign := foreign_requests():
        sys.exit(f"these pages ask another host: {', '.join(foreign)}")
    sys.exit(failed)
