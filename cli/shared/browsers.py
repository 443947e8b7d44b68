"""A browser that opens a window."""

from __future__ import annotations

import os
import subprocess
import webbrowser

IN_TERMINAL = ("lynx", "w3m", "links", "links2", "elinks", "www-browser")  # they would take over the terminal


def find_browser() -> webbrowser.BaseBrowser | None:
    """The default browser; None if there is none, or only one that runs in the terminal."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return None
    if type(browser) is not webbrowser.GenericBrowser:
        return browser
    return None if "BROWSER" not in os.environ or browser.basename in IN_TERMINAL else browser


def open_browser(url: str) -> bool:
    """Opens ``url`` in a browser window; False if there is no such browser."""
    browser = find_browser()
    if browser is None:
        return False
    if type(browser) is not webbrowser.GenericBrowser:
        return browser.open(url)
    # A program of the user's, or of an editor that shows the page in its own window. Its open() would wait for it.
    command = [browser.name, *(word.replace("%s", url) for word in browser.args)]
    nowhere = subprocess.DEVNULL
    try:
        subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere, start_new_session=True)
    except OSError:
        return False
    return True
