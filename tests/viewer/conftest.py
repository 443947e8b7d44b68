"""Fixtures for the page in a browser: one browser context for all tests, and one server per shown
file.
"""

from contextlib import ExitStack

import pytest
import torch

import clod_adapter
import scenes
from shown import SIZE, Shown, fold, serve, take


@pytest.fixture(scope="session")
def tabs(chromium):
    """The browser context of all tabs; a context per test would double the time to the first
    frame.
    """
    with chromium.new_context() as context:
        context.set_default_timeout(10_000)
        yield context


@pytest.fixture
def show(tabs):
    """Opens a tab with the files of a ``clod-adapt view`` command line; an error in its console
    fails the test.
    """
    with ExitStack() as stack:
        opened = []

        def start(*words, url="", state="", viewport=SIZE, context=tabs, script=""):
            url = url or stack.enter_context(serve(*words))
            shown = Shown(context.new_page())
            stack.callback(shown.page.close)
            shown.page.set_viewport_size(viewport)
            shown.page.add_init_script(script)
            opened.append((shown, url))
            return shown.ready(url + state)

        yield start
        for shown, url in opened:
            assert shown.errors == []
            foreign = [each for each in shown.asked if not each.startswith((url, "data:", "blob:"))]
            assert foreign == []


@pytest.fixture
def save(tmp_path):
    def write(gaussians, name="model.ply"):
        clod_adapter.save(tmp_path / name, gaussians)
        return tmp_path / name

    return write


@pytest.fixture(scope="session")
def gaussians():
    """400 Gaussians of SH degree 1 with a dial."""
    return scenes.attenuated(400, 1, 5).replace(sigma_d=torch.linspace(0.1, 15, 400))


@pytest.fixture(scope="session")
def plain(gaussians):
    return gaussians.replace(sigma_d=None, attenuation=None)


@pytest.fixture(scope="session")
def model(gaussians, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "model.ply"
    clod_adapter.save(path, gaussians)
    return path


@pytest.fixture(scope="session")
def tab_of_model(tabs, model):
    with serve(model) as url:
        shown = Shown(tabs.new_page())
        shown.page.set_viewport_size(SIZE)
        yield shown.ready(url)
        shown.page.close()


@pytest.fixture
def shown(tab_of_model, model):
    """The tab of ``tab_of_model``, reset to that file: opening a tab for each test would take a
    second.
    """
    fold(tab_of_model, False)
    tab_of_model.evaluate(
        "document.activeElement.blur(), document.getElementById('target').value = ''"
    )
    take(tab_of_model, model)
    yield tab_of_model
    assert tab_of_model.errors == []
