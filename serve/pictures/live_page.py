"""Takes the pictures of the live page: `live_page.png` and the animated `live_page.webp`.

    python serve/pictures/live_page.py [--seconds 8] [--chromium /usr/bin/chromium]

A simulated sensor plays, `isocharge serve stream --live` follows it, and headless Chromium draws the page. Needs
`pip install '.[all]' playwright pillow`.
"""

import argparse
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

HERE = Path(__file__).parent
WIDTH, HEIGHT = 1280, 770
MODEL = "three-25um-biaxial"
FRAMES_PER_S = 8.0
BEFORE_S = 11.0
"""Time until the traces are full, s."""

CHROMIUM_WORDS = ("--no-sandbox", "--disable-quic", "--disable-gpu", "--enable-unsafe-swiftshader")


def start(*words: str | Path, **options: object) -> "subprocess.Popen[str]":
    """An isocharge command as a process of its own."""
    command = [sys.executable, "-m", "isocharge.cli", "serve", *map(str, words)]
    return subprocess.Popen(command, text=True, **options)  # type: ignore[call-overload,no-any-return]


def take(page: Page, seconds: float) -> list[bytes]:
    """Pictures of the page, one every 1 / FRAMES_PER_S, as PNG."""
    pictures, began = [], time.monotonic()
    while (elapsed := time.monotonic() - began) < seconds:
        page.wait_for_timeout(max(0.0, 1e3 * (len(pictures) / FRAMES_PER_S - elapsed)))
        pictures.append(page.screenshot())
    return pictures


def write(pictures: list[bytes], folder: Path) -> None:
    """The last picture, and all of them smaller and moving."""
    (folder / "live_page.png").write_bytes(pictures[-1])
    size = (3 * WIDTH // 4, 3 * HEIGHT // 4)
    images = [Image.open(io.BytesIO(data)).convert("RGB").resize(size, Image.Resampling.LANCZOS) for data in pictures]
    images[0].save(
        folder / "live_page.webp",
        save_all=True,
        append_images=images[1:],
        duration=round(1e3 / FRAMES_PER_S),
        loop=0,
        quality=60,
        method=6,
    )


def main() -> None:
    """Take them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of the animated picture")
    parser.add_argument("--chromium", default="/usr/bin/chromium", help="program")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        port, log = Path(name) / "film", Path(name) / "log"
        sensor = start("virtual", MODEL, "--link", port, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with log.open("w") as output:
            words = ("stream", MODEL, "--port", port, "--wait", "60", "--output", "none", "--live", "127.0.0.1:0")
            stream = start(*words, stderr=output)
        try:
            while "tared" not in log.read_text():
                if stream.poll() is not None:
                    sys.exit(log.read_text())
                time.sleep(0.1)
            url = log.read_text().split("live page: ")[1].split()[0]
            with sync_playwright() as started:
                browser = started.chromium.launch(executable_path=asked.chromium, args=list(CHROMIUM_WORDS))
                page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
                page.goto(url)
                page.wait_for_timeout(1e3 * BEFORE_S)
                pictures = take(page, asked.seconds)
                browser.close()
        finally:
            for process in (stream, sensor):
                process.terminate()
                process.wait(30)
    write(pictures, HERE)
    print(f"{len(pictures)} pictures, {(HERE / 'live_page.webp').stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
