"""Changes that MkDocs makes to a page: roles of docstrings (``:class:`X```) become the code that they name."""

import re
from typing import Any

ROLE = re.compile(r":(?:class|func|meth|data|attr|mod|exc|obj):<code>~?([^<]+)</code>")


def on_page_content(html: str, **_: Any) -> str:
    return ROLE.sub(r"<code>\1</code>", html)
