"""Shared by tests of the command and of training: file names, expected and injected errors,
interrupts, processes that start fast.
"""

import copy
import json
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch.distributed as dist

import clod_adapter
from clod_adapter import AdaptConfig
from clod_adapter.training.trainer import Trainer
from scenes import stripped

OUTPUTS = ["dial.json", "dial.ply", "dial.safetensors"]
STATE = "dial.resume.safetensors"
fail = Mock(side_effect=ZeroDivisionError("of ours"))

# Imports everything once; a line on stdin starts a process, or asks how one ended.
SERVER = """
import json, os, signal, sys, tempfile
import torch
torch.set_num_threads(1)  # a process that forks must have no threads
from clod_adapter.cli import main
from clod_adapter.cli.adapt import listeners, processes
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import prepare_kernels
from clod_adapter.training import pseudo_views
pseudo_views.MANY = 8  # as in conftest
prepare_kernels(Console(quiet=True))
print("ready", flush=True)
for line in sys.stdin:
    about = json.loads(line)
    if "wait" in about:
        print(os.waitstatus_to_exitcode(os.waitpid(about["wait"], 0)[1]), flush=True)
        continue
    child = os.fork()
    if child == 0:
        os.chdir(about["folder"])
        tempfile.tempdir = os.path.dirname(about["folder"])
        os.environ.update(about["environment"])
        log = os.open(about["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(log, stream)
        torch.set_num_threads(1 if about["environment"] else 2)
        listeners.SAVE_EVERY, listeners.SAVE_COST = 0.0, 1e9  # a state after each step
        code = 1
        try:
            exec(about["before"])
            code = main.main(about["words"])
        finally:
            sys.stdout.flush()
            os._exit(code)
    print(child, flush=True)
"""


def accepted(words):
    """The words of a command, as text; adapting, which takes few steps here, accepts its loss."""
    texts = list(map(str, words))
    adapts = texts and Path(texts[0]).suffix and "--help" not in texts
    return [*texts, "--accept-loss"] if adapts else texts


class Server:
    """Runs ``clod-adapt`` in forked processes, which start quickly."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVER],
            text=True,
            bufsize=1,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self.process.stdout.readline() == "ready\n"

    def ask(self, **about):
        self.process.stdin.write(json.dumps(about) + "\n")
        return int(self.process.stdout.readline())

    def start(self, folder, *words, rank="", before="", **environment):
        """The process's id, valid until it is waited for; ``before`` is code that it runs first."""
        return self.ask(
            folder=str(folder),
            log=f"{folder}{rank}.log",
            words=accepted(words),
            before=before,
            environment={name: str(value) for name, value in environment.items()},
        )

    def wait(self, pid):
        return self.ask(wait=pid)

    def run(self, folder, *words):
        """What was printed."""
        assert self.wait(self.start(folder, *words)) == 0, log_of(folder)
        return log_of(folder)


class Launched:
    """``size`` processes started as by torchrun; ``before`` is code that some run first; until file
    ``wait`` exists.
    """

    def __init__(self, server, folder, *words, size=2, before=None, wait=""):
        folder.mkdir(exist_ok=True)
        self.server, self.folder = server, folder
        self.store = dist.TCPStore("localhost", 0, is_master=True, wait_for_workers=False)
        told = {
            "WORLD_SIZE": size,
            "LOCAL_WORLD_SIZE": size,
            "MASTER_ADDR": "localhost",
            "MASTER_PORT": self.store.port,
            "TORCHELASTIC_USE_AGENT_STORE": True,
            "TORCHELASTIC_RESTART_COUNT": 0,
        }
        self.pids = [
            server.start(
                folder,
                *words,
                rank=k,
                before=(before or {}).get(k, ""),
                RANK=k,
                LOCAL_RANK=k,
                **told,
            )
            for k in range(size)
        ]
        wait_for(folder / wait)

    def log(self, rank):
        return log_of(self.folder, rank)

    def wait(self):
        return [self.server.wait(pid) for pid in self.pids]

    def report(self):
        assert [name for name in names(self.folder) if name != STATE] == OUTPUTS, self.log(0)
        assert clod_adapter.load(self.folder / "dial.ply").gaussians.sigma_d is not None
        clod_adapter.load_adapter(self.folder / "dial.safetensors")
        return json.loads((self.folder / "dial.json").read_text())


def counted(steps):
    """A progress callback that notes how much is done, of how much."""
    return lambda now: steps.append((now.done, now.total))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def log_of(folder, rank=""):
    return Path(f"{folder}{rank}.log").read_text()


def contents(*roots):
    paths = chain(roots, *(root.rglob("*") for root in roots))
    return {path: path.read_bytes() for path in paths if path.is_file()}


def results(folder, name="dial"):
    """The PLY and the adapter, without measured times."""
    return {
        suffix: stripped((folder / f"{name}{suffix}").read_bytes())
        for suffix in (".ply", ".safetensors")
    }


def rebuilt(clod, base, *more):
    """Whether ``apply`` gives ``dial.ply`` from its adapter, bit for bit."""
    clod("apply", base, "dial.safetensors -o same.ply", *more)
    return Path("same.ply").read_bytes() == Path("dial.ply").read_bytes()


def wait_for(path, text=""):
    """Until the file exists and has this text."""
    until = time.monotonic() + 60
    while not path.exists() or (text and text not in path.read_text()):
        assert time.monotonic() < until, f"{path} did not appear"
        time.sleep(0.002)


def pressing(real, *numbers, at=1):
    """``real``, interrupted by these signals at the beginning of its ``at``-th call."""
    calls = count(1)

    def interrupted(*given, **rest):
        for number in numbers if next(calls) == at else ():
            signal.raise_signal(number)
        return real(*given, **rest)

    return interrupted


@contextmanager
def pressed(place, name, *numbers, at=1):
    """Within the context a function, ``place.name``, is interrupted as by ``pressing``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(place, name, pressing(getattr(place, name), *numbers, at=at))
        yield


def change_step(patch, at, change):
    """Replaces the gradients of the ``at``-th step by ``change`` of them, not in the kernels' runs
    of one step.
    """
    real = Trainer.gradient_sum
    steps = count(1)

    def changed(self, *given):
        gradients = real(self, *given)
        chosen = self.config.iters > 1 and next(steps) == at
        return change(gradients) if chosen else gradients

    patch.setattr(Trainer, "gradient_sum", changed)


def config_of(**changes):
    """Fixed settings, so that the tests do not depend on the defaults."""
    settings = {
        "start_share": 0.6,
        "lr_sigma": 1e-2,
        "lr_growth": 1e-2,
        "lr_means": 3e-5,
        "lr_quats": 4e-4,
        "lr_scales": 2e-3,
        "lr_opacities": 1e-2,
        "lr_sh0": 1e-3,
        "lr_shN": 5e-5,
    }
    return AdaptConfig(**(settings | changes))


def states_of(steps, found):
    """A progress callback that keeps the states after these steps."""

    def keep(progress):
        if progress.state and progress.done in steps:
            found[progress.done] = copy.deepcopy(progress.state())

    return keep


def data_in(page, name):
    """The texts of the elements of a page that hold data, such as ``clod-config``."""
    return re.findall(rf'id="{name}">(.*?)</script>', page, re.S)
