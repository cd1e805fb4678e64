"""Pictures of the page of `playslot play`, by a headless Chromium, as a user would make them:

make test-browser  # installs Playwright
.venv/bin/python docs/_site/play_pictures.py
"""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any, Final

from PIL import Image
from playwright.sync_api import sync_playwright

from playslot_rl.runtime.processes import free_port

IMAGES: Final = Path(__file__).resolve().parents[1] / "images"
MODEL: Final = "pretrained/block_push_easy"
CUBE: Final = 3
"""The slot that holds the cube, as the page counts."""
SLOTS: Final = 5
COLOURS: Final = 256


def save(name: str, screenshot: bytes) -> None:
    """A small PNG in docs/images."""
    picture = Image.open(io.BytesIO(screenshot)).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    picture.save(IMAGES / name, optimize=True)
    print(f"docs/images/{name}")


def press(page: Any, keys: str) -> None:
    """Press keys one after the other, each when the page shows the moment that the one before led to."""
    for key in keys:
        before = page.get_by_text("; moment ").inner_text()
        page.keyboard.press(key)
        page.wait_for_function("before => !document.body.innerText.includes(before)", arg=before)


def draw(page: Any, address: str) -> None:
    """Both pictures."""
    page.goto(address)
    page.get_by_text("; moment 0,").wait_for()
    press(page, "4114440")
    page.get_by_role("switch", name="Colour the slots").click()
    page.wait_for_timeout(20_000)  # the prototypes' animations
    save("play.png", page.screenshot(full_page=True))
    page.get_by_role("switch", name="Colour the slots").click()
    press(page, "r")
    strip = page.locator(".pixels").nth(2)
    box = strip.bounding_box()
    strip.click(position={"x": box["width"] * (CUBE - 0.5) / SLOTS, "y": box["height"] / 2})
    page.get_by_text(f"Slot {CUBE}", exact=True).wait_for()
    page.get_by_text("Remove", exact=True).click()
    page.get_by_text("; moment 1,").wait_for()
    press(page, "00")
    page.wait_for_timeout(1000)
    top, end = page.get_by_text("; moment ").bounding_box(), strip.bounding_box()
    area = {"x": top["x"], "y": top["y"], "width": end["width"], "height": end["y"] + end["height"] - top["y"]}
    save("play_touch.png", page.screenshot(clip=area))


def listening(output: Path, server: subprocess.Popen[bytes]) -> str:
    """The address that the server prints, once it answers."""
    while server.poll() is None:
        found = re.search(r"http://\S+", output.read_text())
        with contextlib.suppress(OSError):
            if found is not None:
                urllib.request.urlopen(found[0], timeout=5).close()
                return found[0]
        time.sleep(0.5)
    raise RuntimeError("the server ended")


def main() -> None:
    """Serve the page, draw it, end the server."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        command = [sys.executable, "-m", "playslot_rl", "play", f"run={MODEL}", f"port={free_port()}", "device=cpu"]
        output = Path(folder) / "output.txt"
        with output.open("w") as written:
            server = subprocess.Popen(command, cwd=folder, stdout=written)
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        try:
            address = listening(output, server)
            draw(browser.new_page(viewport={"width": 1280, "height": 800}), address)
        finally:
            browser.close()
            server.terminate()
            server.wait()


if __name__ == "__main__":
    main()
