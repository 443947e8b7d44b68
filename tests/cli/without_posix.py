"""Removes from Python what Windows or macOS lack, then runs ``clod-adapt`` with each list of words
of a JSON list.

    python without_posix.py JSON

Where a renamed, replaced or removed file is open or mapped in this process, that raises the
PermissionError of Windows.
"""

import json
import os
import signal
import sys
from importlib import import_module
from importlib.abc import MetaPathFinder

# these look at sys.platform, and use what Linux has
USED = "filelock numba plyfile pycolmap safetensors.torch skimage.metrics torch tqdm"
for other in USED.split():
    import_module(other)
ABSENT = """
sched_getaffinity sched_setaffinity posix_fadvise posix_fallocate fork getuid geteuid setsid killpg
mkfifo fchmod chown getloadavg sysconf pread pwrite
"""
SIGNALS = "SIGHUP SIGUSR1 SIGUSR2 SIGXCPU SIGKILL pthread_sigmask setitimer"
MODULES = ["fcntl", "resource", "termios", "pwd", "grp", "pty", "tty"]


class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def open_files():
    """What this process has open or mapped."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            found.add(os.readlink(f"/proc/self/fd/{number}"))
        except OSError:  # that of the listing
            continue
    fd = READ(b"/proc/self/maps", os.O_RDONLY)
    with os.fdopen(fd) as maps:
        return found | {line.split(None, 5)[5].strip() for line in maps if line.count("/")}


def watch(event, given):
    global busy
    if busy:
        return
    if event == "open" and str(given[0]).startswith(("/proc", "/sys", "/dev/fd")):
        raise FileNotFoundError(2, "No such file or directory", given[0])
    if event in ("os.rename", "os.remove", "os.rmdir"):
        busy = True
        taken = open_files()
        busy = False
        for name in given[: 2 if event == "os.rename" else 1]:
            if os.path.abspath(os.fsdecode(name)) in taken:
                raise PermissionError(
                    13, "The process cannot access the file because it is being used", name
                )


READ = os.open
busy = False
for module, names in ((os, ABSENT), (signal, SIGNALS)):
    for name in names.split():
        delattr(module, name)
for name in MODULES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent())
sys.addaudithook(watch)

from clod_adapter.cli.main import main  # noqa: E402
from clod_adapter.training import pseudo_views  # noqa: E402

pseudo_views.MANY = 8  # as in conftest
for words in json.loads(sys.argv[1]):
    if (code := main(words)) != 0:
        sys.exit(f"exit code {code}: {' '.join(words)}")
