"""Several processes: the result of one; a killed process, an interrupt or bad input ends all of
them.
"""

import json
import os
import signal

import pytest
import torch
from refusals import refused

from clod_adapter import AdaptConfig, load
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.command import make_config
from clod_adapter.cli.shared.process import Launch, launched
from clod_adapter.training.state import load_state
from runs import STATE, Launched, log_of

TINY = ("--max-sv", 4, "--out", "dial.ply", "--batch", 2, "--iters", 12)
LONG = (*TINY[:-1], 4000)  # does not end by itself


@pytest.fixture(scope="module")
def words(capture):
    return [capture.ply, "--images", capture.scene]


def test_time_budget_ends_all_after_the_same_step(server, words, tmp_path):
    """By the clock of the first process; that of the second is far ahead."""
    ahead = (
        "import clod_adapter.training.loop as t; at = t.time.perf_counter; t.time.perf_counter ="
        " lambda: 1e3 * at()"
    )
    run = Launched(server, tmp_path / "run", *words, *LONG, "--time-budget", 0.3, before={1: ahead})
    assert run.wait() == [0, 0], run.log(0)
    assert 1 <= run.report()["steps"] < 4000 and not run.report()["interrupted"]


def test_signals_of_the_launcher_do_not_end_the_writing(server, words, tmp_path):
    """It sends them after a lost process, and repeats its own, until the process ends."""
    pressed = (
        "import argparse; from clod_adapter import pipeline; from clod_adapter.cli.adapt import"
        " run\ndef pressing(real):\n    def call(*arguments, **more):\n        for number in"
        " (signal.SIGTERM, signal.SIGINT, signal.SIGTERM): signal.raise_signal(number)\n       "
        " return real(*arguments, **more)\n    return call\nrun.explain ="
        " pressing(run.explain)\npipeline.save_adapter ="
        " pressing(pipeline.save_adapter)\nrun.print_summary ="
        " pressing(run.print_summary)\nmain.json = argparse.Namespace(dumps=pressing(json.dumps))"
    )
    run = Launched(
        server,
        tmp_path / "run",
        *words,
        *LONG,
        "--quiet",
        "--json",
        before={0: pressed},
        wait=STATE,
    )
    os.kill(run.pids[1], signal.SIGKILL)
    assert run.wait() == [0, -signal.SIGKILL], run.log(0)
    report = run.report()
    steps = report["steps"]
    assert json.loads(run.log(0))["steps"] == load_state(run.folder / STATE)[0].steps == steps > 0
    assert report["interrupted"] and report["rows"] == []
    note = f"training ended at step {steps}: a process of the group has ended"
    assert note in str(report["notes"])


BREAK = """
from clod_adapter.training.trainer import Trainer
real, calls = Trainer.gradient_sum, []
def pull(*arguments):
    calls.append(1)
    if len(calls) == 5: raise MemoryError('no room for this view')
    return real(*arguments)
Trainer.gradient_sum = pull
"""


def test_two_give_the_result_of_one(server, words, tmp_path):
    """Within the rounding of sums in another order, also resumed after an error of the second
    process in a step.
    """
    alone = Launched(server, tmp_path / "alone", *words, *TINY, size=1)
    run = Launched(server, tmp_path / "run", *words, *TINY, before={1: BREAK})
    assert run.wait() == [0, 2], run.log(0)
    report = run.report()
    assert report["steps"] == 4 and report["interrupted"] and run.log(1) == "", run.log(0)
    assert "; process 1: no room for this view" in run.log(0)
    assert load_state(run.folder / STATE)[0].steps == 4
    again = Launched(server, run.folder, *words, *TINY, "--resume")
    assert again.wait() == [0, 0], again.log(0) + again.log(1) + alone.log(0)
    assert alone.wait() == [0], again.log(0) + again.log(1) + alone.log(0)
    report = again.report()
    want = alone.report()
    assert report["processes"].items() >= {"count": 2, "backend": "gloo", "batch": 2}.items()
    assert want["processes"]["count"] == 1
    assert (report["resumed_from"], report["steps"], report["interrupted"]) == (4, 12, False)
    assert again.log(0).count("2 processes (gloo): 2 views a step, 12 steps") == 1
    assert again.log(1) == "" and not (run.folder / STATE).exists()
    psnr = [row["psnr"] for row in want["rows"]]
    assert [row["psnr"] for row in report["rows"]] == pytest.approx(psnr, abs=1e-3)
    found = load(again.folder / "dial.ply").gaussians
    wanted = load(alone.folder / "dial.ply").gaussians
    assert found.attenuation == wanted.attenuation and len(report["rows"]) > 1
    for name, tensor in wanted.tensors().items():
        torch.testing.assert_close(found.tensors()[name], tensor, rtol=1e-4, atol=1e-4)


def test_process_lost_before_the_first_step(server, words, tmp_path):
    """Nothing is written."""
    lost = "def adapt(*_, **__): raise MemoryError('no room')\nprocesses.adapt = adapt"
    run = Launched(server, tmp_path / "run", *words, *TINY, before={1: lost})
    assert run.wait() == [2, 2], run.log(0)
    assert run.log(1) == "", run.log(0)
    assert list(run.folder.iterdir()) == [], run.log(0)
    log = run.log(0)
    assert log.count("error:") == 1
    assert "; process 1: no room; this was before the first step, so start again\n" in log


def test_interrupt_stops_all_after_the_same_step(server, words, tmp_path):
    run = Launched(server, tmp_path / "run", *words, *LONG, wait=STATE)
    os.kill(run.pids[1], signal.SIGINT)  # either process
    assert run.wait() == [0, 0], run.log(0)
    report = run.report()
    assert report["interrupted"], run.log(0)
    assert load_state(run.folder / STATE)[0].steps == report["steps"], run.log(0)
    assert "gone" not in str(report["notes"]) and run.log(1) == ""


def test_bad_input_is_reported_once(server, words, tmp_path):
    for given, message in (
        ([*words, "--batch", 1], "--batch is 1, it must be at least 2: a view for each process"),
        (["eval", "nowhere.ply", "--images", "scene"], "only adapting takes several processes"),
    ):
        run = Launched(server, tmp_path / "run", *given)
        assert run.wait()[0] == 2 and run.log(0).count("\n") == 1, run.log(0)
        assert f"clod-adapt: error: {message}" in run.log(0)
        assert run.log(1) == ""
        assert not list(run.folder.iterdir())


AGENT = """
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from clod_adapter.training.trainer import Trainer
real = Trainer.gradient_sum
def pull(*arguments):
    if os.environ['RANK'] == '1' and os.path.exists('dial.resume.safetensors'):
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments)
Trainer.gradient_sum = pull
config = LaunchConfig(
    1, 1, 2, rdzv_backend='c10d', rdzv_endpoint='localhost:0', start_method='fork', max_restarts=0
)
elastic_launch(config, lambda: os._exit(main.main(about['words'])))()
"""


def test_torchrun_with_a_killed_process(server, words, tmp_path):
    """By torchrun's agent, which sends SIGTERM to the first process once the second is gone."""
    folder = tmp_path / "run"
    folder.mkdir()
    assert server.wait(server.start(folder, *words, *LONG, before=AGENT, OMP_NUM_THREADS=1)) == 1
    run = Launched(server, folder, size=0)
    log = log_of(folder)
    report = run.report()
    assert "a process of the group has ended" in log and log.count("2 processes (gloo)") == 1
    assert report["interrupted"] and report["steps"] == load_state(folder / STATE)[0].steps


def test_rank_and_default_steps_from_the_environment(monkeypatch):
    """Any number of processes takes the same number of views by default."""

    def launch_of(rank, size=4, **address):
        for name, value in {"RANK": rank, "WORLD_SIZE": size, **address}.items():
            monkeypatch.setenv(name, str(value))
        return launched()

    assert launch_of("1") == Launch()
    assert launch_of("1", MASTER_ADDR="localhost", MASTER_PORT="1") == Launch(1, 4, 0, 1)
    for rank in ("4", "-1", "one"):
        with refused("inconsistent .*; start the processes with torchrun"):
            launch_of(rank)
    steps = AdaptConfig().steps
    for words, size, want in (
        ((), 1, (1, steps)),
        ((), 4, (4, round(steps / 4))),
        (("--iters", "100"), 4, (4, 100)),
    ):
        launch_of("0", size)
        config = make_config(build_parser("").parse_args(["x.ply", *words]))
        assert (config.batch, config.for_views(1).iters) == want, words
