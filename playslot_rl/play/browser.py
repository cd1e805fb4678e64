"""What the page has the browser do by itself: looks, and keys that belong to the page."""

from __future__ import annotations

from typing import Final

from nicegui import ui

STYLE: Final = """
.pixels img { image-rendering: pixelated }
.proto img { image-rendering: pixelated; width: 66px }
.q-uploader__subtitle { display: none }
"""

CLEAN: Final = "<script>history.replaceState(null, '', location.pathname)</script>"
"""The token leaves the address bar and the history; a cookie carries it on."""

AWAY: Final = "<script>window.addEventListener('blur', () => emitEvent('away'))</script>"
"""A key that is let go in another window is never told of."""

SPACE: Final = """<script>
for (const kind of ['keydown', 'keyup']) window.addEventListener(kind, (event) => {
  if (event.key !== ' ' || event.target.closest('input, textarea, select, [role=listbox], [contenteditable]')) return;
  if (event.target === document) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  document.dispatchEvent(new KeyboardEvent(kind, event));
}, true);
</script>"""
"""Space plays; it does not press the button or the switch that has the focus as well. Enter presses it."""


def prepare(title: str) -> None:
    """Put this into the page; while its HTML is written, since scripts that come later do not run."""
    ui.page_title(title)
    ui.add_css(STYLE)
    for script in (CLEAN, AWAY, SPACE):
        ui.add_body_html(script)
