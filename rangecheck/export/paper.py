"""A page as it comes out of a printer: PDF by a headless Chromium, a program of its own that asks nothing of the network."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from rangecheck.errors import OutputError
from rangecheck.files import whole_file

#: names under which Chromium is found
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: time that the page's scripts are given to draw, ms, and the browser to end, s
DRAWN_MS, ENDED_S = 30_000, 300


def write_pdf(page: str | Path, path: str | Path, *, force: bool = True) -> None:
    """Print the HTML file `page` to `path`. Raises OutputError without Chromium, or where it cannot."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise OutputError(
            path, "needs Chromium (apt-get install chromium); or open the report in any browser and print it to a file"
        )
    with whole_file(path, force=force) as part, tempfile.TemporaryDirectory() as profile:
        flags = [
            "--headless", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-pdf-header-footer",
            f"--virtual-time-budget={DRAWN_MS}", f"--user-data-dir={profile}", f"--print-to-pdf={part.resolve()}",
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:  # its sandbox is not for root
            flags.append("--no-sandbox")
        try:
            done = subprocess.run(
                [browser, *flags, Path(page).resolve().as_uri()],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=ENDED_S,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise OutputError(path, f"was not printed: {error}") from None
        if part.stat().st_size == 0:
            said = done.stderr.strip().splitlines()
            raise OutputError(
                path, f"was not printed: Chromium said {said[-1] if said else f'nothing, status {done.returncode}'}"
            )
