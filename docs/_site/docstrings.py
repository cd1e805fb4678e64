"""Our docstrings as mkdocstrings understands them, without a change of their meaning."""

from __future__ import annotations

import re
from typing import Any, Final

from griffe import Extension, Object

SHARED: Final = re.compile(r"^( +)(\w+(?:, \w+)+): (.*(?:\n\1 +\S.*)*)", re.MULTILINE)
"""Arguments with one description, `first, second: text`; each gets it, so that each is checked and typed."""
OPTIONAL: Final = re.compile(r",\] \[")
"""Between optional dimensions, `([B,] [T,] N, D)`: a link in Markdown."""


class OurDocstrings(Extension):
    """Rewrites docstrings as they are read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Before the docstring is parsed."""
        if obj.docstring is None:
            return
        text = obj.docstring.value
        text = SHARED.sub(lambda m: "\n".join(f"{m[1]}{name}: {m[3]}" for name in m[2].split(", ")), text)
        text = re.sub(r"^Example:$", "Examples:", text, flags=re.MULTILINE)
        obj.docstring.value = OPTIONAL.sub(r",] \[", text)
