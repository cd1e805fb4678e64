"""The page in headless Chromium, as a user has it: `make test-browser`."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from served import OUTPUT, served

from playslot_rl.datasets.verify import verify

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install --no-install-recommends chromium"),
]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path, subprocess.Popen[str]]]:
    """`playslot play` with the shipped model; its address, and the folder it runs in."""
    folder = tmp_path_factory.mktemp("play")
    with served(folder, "run=pretrained/block_push_easy") as (address, process):
        yield address, folder, process


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless browser."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: make test-browser installs it")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def open_page(browser: Any, address: str) -> tuple[Any, set[str]]:
    """A page that has begun, and the hosts that it asks."""
    page, hosts = browser.new_page(viewport={"width": 1500, "height": 820}), set[str]()
    page.on("request", lambda request: hosts.add(request.url.split("/")[2]) if "//" in request.url else None)
    page.goto(address)
    wait(page, lambda: moment(page) == 0)
    return page, hosts


def wait(page: Any, true: Callable[[], bool]) -> None:
    """Wait for something to become true, a minute at most: other jobs may have the cores."""
    for _ in range(600):
        if true():
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"nothing happened for a minute; the page says: {page.inner_text('body')[:500]}")


def moment(page: Any) -> int:
    """The depth of the moment that the page shows."""
    found = re.search(r"; moment (\d+)", page.inner_text("body"))
    return -1 if found is None else int(found[1])


def picture(page: Any) -> bytes:
    """What the imagined scene looks like on the screen."""
    content: bytes = page.locator(".pixels").first.screenshot()
    return content


def says(page: Any, text: str) -> bool:
    """Whether a text is on the page."""
    return text in page.inner_text("body")


def test_hold_upload_and_touch(server: tuple[str, Path, subprocess.Popen[str]], tmp_path: Path) -> None:
    """A button acts until let go; a picture is played from, a broken one told of; a slot is frozen and removed."""
    address, _, _ = server
    with chromium() as browser:
        page, _ = open_page(browser, address)
        page.get_by_text("steps while held", exact=True).click()
        button = page.locator("button:has(.proto)").nth(1)
        button.hover()
        page.mouse.down()
        wait(page, lambda: moment(page) >= 3)
        page.mouse.up()
        page.wait_for_timeout(500)  # a step that was under way
        stopped = moment(page)
        page.wait_for_timeout(1000)
        assert moment(page) == stopped >= 3, "letting go ends it"

        page.keyboard.down("1")
        wait(page, lambda: moment(page) >= stopped + 2)
        page.evaluate("window.dispatchEvent(new Event('blur'))")
        page.wait_for_timeout(500)
        left = moment(page)
        page.wait_for_timeout(1000)
        assert moment(page) == left, "a key that is let go in another window, too"
        page.keyboard.up("1")

        assert not page.locator(".q-uploader__subtitle").is_visible(), "nothing is uploaded, so it says no bytes"
        rate, label = (
            page.locator("[role=slider]").nth(1).bounding_box(),
            page.get_by_text("frames a second").bounding_box(),
        )
        assert rate["y"] < label["y"] + label["height"] / 2 < rate["y"] + rate["height"], "beside its slider"

        true = page.locator(".pixels").nth(1)
        assert true.is_visible()
        Image.fromarray(np.full((96, 128, 3), 90, np.uint8)).save(tmp_path / "grey.png")
        chooser = page.locator("input[type=file]").first
        chooser.set_input_files(tmp_path / "grey.png")
        wait(page, lambda: says(page, "grey.png") and moment(page) == 0)
        wait(page, lambda: not true.is_visible())  # no simulator stands behind a picture
        (tmp_path / "broken.png").write_bytes(b"no picture")
        chooser.set_input_files(tmp_path / "broken.png")
        wait(page, lambda: says(page, "broken.png"))
        assert moment(page) == 0

        page.get_by_text("Start here", exact=True).click()
        wait(page, true.is_visible)
        page.get_by_text("Remove", exact=True).click()
        wait(page, lambda: says(page, "choose a slot first"))
        page.locator(".pixels").first.click(position={"x": 190, "y": 190})
        wait(page, lambda: re.search(r"Slot \d", page.inner_text("body")) is not None)
        page.get_by_text("Freeze", exact=True).click()
        wait(page, lambda: says(page, ", frozen"))
        before = picture(page)
        page.get_by_text("Remove", exact=True).click()
        wait(page, lambda: says(page, "None: click one"))
        assert picture(page) != before


def test_space_plays_and_presses_nothing_that_has_the_focus(server: tuple[str, Path, subprocess.Popen[str]]) -> None:
    """After a click on a button or a switch, and where the keyboard has put the focus; in a number it is typed."""
    address, folder, _ = server
    with chromium() as browser:
        page, _ = open_page(browser, address)
        plays = page.locator("[role=switch]", has_text="Go on by itself")

        def toggled(focus: Callable[[], Any]) -> None:
            """Space after something got the focus plays, and space once more ends it."""
            focus()
            for wanted in ("true", "false"):
                page.keyboard.press("Space")
                wait(page, lambda: plays.get_attribute("aria-checked") == wanted)  # noqa: B023
                page.wait_for_timeout(700)  # what else it might have done
                assert plays.get_attribute("aria-checked") == wanted

        page.locator(".pixels").first.click(position={"x": 190, "y": 190})
        wait(page, lambda: re.search(r"Slot \d", page.inner_text("body")) is not None)
        page.get_by_text("Remove", exact=True).click()
        wait(page, lambda: says(page, "removed"))
        page.locator(".pixels").first.click(position={"x": 30, "y": 30})
        wait(page, lambda: re.search(r"Slot \d", page.inner_text("body")) is not None)
        toggled(page.locator("button", has_text="Remove").focus)
        page.get_by_text("Back to the start", exact=True).click()
        toggled(lambda: page.get_by_role("switch", name="Colour the slots").focus())
        assert page.get_by_role("switch", name="Colour the slots").get_attribute("aria-checked") == "false"
        page.get_by_text("Record", exact=True).click()
        wait(page, lambda: says(page, "written: "))
        toggled(lambda: None)
        assert not says(page, "removed;")
        assert [path.name for path in (folder / "runs" / "play").iterdir() if path.is_dir()] == ["recording-001"]
        assert "token" not in page.url
        page.reload()
        wait(page, lambda: moment(page) == 0)


def test_a_user_plays_records_and_leaves(server: tuple[str, Path, subprocess.Popen[str]]) -> None:
    address, folder, process = server
    with chromium() as browser:
        page, hosts = open_page(browser, address)
        other, _ = open_page(browser, address)
        before = picture(page)
        for number, key in enumerate("1123", 1):
            page.keyboard.press(key)
            wait(page, lambda: moment(page) == number)  # noqa: B023
        assert picture(page) != before
        plain = picture(page)
        page.keyboard.press("m")
        wait(page, lambda: picture(page) != plain)
        page.keyboard.press("u")
        wait(page, lambda: moment(page) == 3)
        page.get_by_text("latent policy", exact=True).click()
        wait(page, lambda: moment(page) >= 5)
        page.get_by_text("I steer", exact=True).click()
        assert moment(other) == 0
        other.keyboard.press("2")
        wait(other, lambda: moment(other) == 1)
        other.close()
        page.get_by_text("Record", exact=True).click()
        wait(page, lambda: "written: " in page.inner_text("body"))
        assert hosts == {address.removeprefix("http://").partition("/")[0]}, "nothing from outside"
    recording = folder / "runs" / "play" / "recording-002"  # another one is of the test before
    result = verify(recording / "dataset")
    assert result.ok, result.lines()
    assert result.frames >= 6
    assert (recording / "session.gif").is_file()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert (folder / OUTPUT).read_text().splitlines()[-1] == "stopped"
    assert sorted(path.name for path in (folder / "runs" / "play").iterdir()) == [
        ".lock",
        "recording-001",
        "recording-002",
    ]
