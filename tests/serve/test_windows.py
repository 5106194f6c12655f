"""Without POSIX: what Windows does not have is hidden, and all but a pseudo-terminal works.

pyserial has a part for each system, so it is imported before its Linux part is hidden from everything else.
"""

import json
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from isocharge.serve import Frame, encode_frame

HIDE = """
import os, select, signal, socket, sys, serial

for name in ("termios", "fcntl", "tty", "pty", "pwd", "grp", "resource", "crypt", "syslog", "readline"):
    sys.modules[name] = None
for module, names in {
    os: "fork forkpty openpty posix_spawn ttyname getuid geteuid getgid getpgid setsid killpg mkfifo mknod statvfs"
        " set_blocking get_blocking sched_getaffinity nice chown O_NONBLOCK O_CLOEXEC O_NOFOLLOW"
        " O_DIRECTORY O_NOCTTY fchmod pread pwrite",
    signal: "SIGALRM SIGHUP SIGUSR1 SIGUSR2 SIGPIPE SIGCHLD setitimer alarm pthread_sigmask pthread_kill ITIMER_REAL",
    socket: "AF_UNIX",
    select: "poll epoll",
}.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
on_linux, select_on_linux = os.open, select.select

def only_sockets(*waiting):
    if any(isinstance(item, int) for group in waiting[:3] for item in group):
        raise OSError(10038, "An operation was attempted on something that is not a socket")
    return select_on_linux(*waiting)

def no_folders(path, *rest, **options):
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return on_linux(path, *rest, **options)

select.select, os.open = only_sockets, no_folders
"""


def run(code, *arguments, stdin=None, cwd=None):
    """Python code where POSIX is hidden: (exit code, stdout, stderr)."""
    words = [sys.executable, "-c", HIDE + code, *map(str, arguments)]
    done = subprocess.run(words, input=stdin, cwd=cwd, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout, done.stderr


COMMAND = "from isocharge.cli.main import main; main()"


def test_posix_is_hidden():
    _, _, err = run("import termios")
    assert "halted" in err


def test_everything_of_serve_is_imported_and_predicts():
    code = """
import isocharge.serve as serve
predictor = serve.Predictor("three-25um-biaxial")
contact = predictor.predict([942.9, 910.4, 690.8])
missing = [name for name in serve.__all__ if not hasattr(serve, name)]
print(missing, round(contact.force_N, 2), serve.__version__ > "0")
"""
    code, out, err = run(code)
    assert (code, out) == (0, "[] 1.0 True\n"), err


@pytest.mark.parametrize("portion", ["simulate", "train"])
def test_the_other_portions_are_imported(portion):
    code, out, err = run(f"import isocharge.{portion}; print('ok')")
    assert (code, out) == (0, "ok\n"), err


def test_pyserial_itself_is_not_needed_to_predict():
    """Its import fails where neither of its parts fits."""
    code, out, err = run("sys.modules['serial'] = None\nfrom isocharge.serve import Predictor, Port; print('ok')")
    assert (code, out) == (0, "ok\n"), err


def test_predict_on_the_command_line():
    words = ("serve", "predict", "three-25um-biaxial", "-")
    code, out, err = run(COMMAND, *words, stdin="A,B,C\n942.9,910.4,690.8\n")
    assert code == 0, err
    assert out.splitlines()[1].split(",")[2].startswith("1.00")


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("serve", "stream", "--help"), ("simulate", "--help")])
def test_help(words):
    assert run(COMMAND, *words)[0] == 0


@contextmanager
def board():
    """A TCP port that sends frames at 200 Hz, as a serial server does: its pyserial URL."""
    rows = [(0.0, 0.0, 0.0)] * 120 + [(942.9, 910.4, 690.8)] * 10_000
    stop = threading.Event()

    def send():
        with listening.accept()[0] as connection:
            for number, row in enumerate(rows):
                if stop.wait(0.005):
                    return
                try:
                    connection.sendall(encode_frame(Frame(number, 5000 * number, row)))
                except OSError:
                    return

    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(30.0)
        thread = threading.Thread(target=send)
        thread.start()
        yield f"socket://127.0.0.1:{listening.getsockname()[1]}"
        stop.set()
        thread.join()


def test_a_port_is_read_by_pyserial():
    code = """
from itertools import islice
from isocharge.serve import Port, Predictor, stream
with Port(sys.argv[1]) as port:
    records = list(islice(stream(port, Predictor("three-25um-biaxial")), 300))
print(len(records), round(records[-1].force_N, 2))
"""
    with board() as url:
        code, out, err = run(code, url)
    assert (code, out) == (0, "300 1.0\n"), err


def test_a_stream_is_recorded_and_ends_by_itself(tmp_path):
    with board() as url:
        words = ("serve", "stream", "three-25um-biaxial", "--port", url, "--seconds", 3, "--record", tmp_path / "a.rec")
        code, out, err = run(COMMAND, *words)
    assert code == 0, err
    lines = [json.loads(line) for line in out.splitlines()]
    assert 130 < len(lines) < 800
    assert round(lines[-1]["force_N"], 2) == 1.0
    code, again, err = run(COMMAND, "serve", "replay", tmp_path / "a.rec")
    assert (code, [json.loads(line) for line in again.splitlines()]) == (0, lines), err


def test_a_pseudo_terminal_says_what_it_needs(tmp_path):
    code = """
from isocharge.serve import VirtualSensor, wander
from isocharge.common.errors import PortError
try:
    with VirtualSensor(lambda x, y, force: force[:, None] * [[1.0, 1.0, 1.0]], wander(seed=1)):
        pass
except PortError as error:
    print(error)
"""
    code, out, err = run(code, cwd=tmp_path)
    assert code == 0, err
    assert out.startswith("a virtual sensor needs a pseudo-terminal, and this system has none")
    assert "Linux" in out


@pytest.mark.parametrize("words", [("serve", "virtual", "three-25um-biaxial"), ("demo",)])
def test_a_command_that_plays_a_virtual_sensor_says_so_before_it_computes(words, tmp_path):
    code, _, err = run(COMMAND, *words, cwd=tmp_path)
    assert (code, list(tmp_path.iterdir())) == (1, [])
    assert "PortError: a virtual sensor needs a pseudo-terminal" in err
    assert "Traceback" not in err


def test_a_run_goes_on_and_keeps_others_out_with_the_lock_of_windows(tmp_path):
    """Locks of `msvcrt`: the second one of a file is refused."""
    code = """
import types
from pathlib import Path
held = set()

def locking(descriptor, mode, size):
    if (mode, size) != (2, 1) or os.fstat(descriptor).st_ino in held:
        raise PermissionError(13, "Permission denied")
    held.add(os.fstat(descriptor).st_ino)

sys.modules["msvcrt"] = types.SimpleNamespace(locking=locking, LK_NBLCK=2)
from isocharge.common.errors import OutputExists
from isocharge.common.resumable_run import resume_folder
with resume_folder(Path("run"), {"seed": 1}) as work:
    work.save("part", b"data", final=True)
    try:
        with resume_folder(Path("run"), {"seed": 1}):
            pass
    except OutputExists as error:
        print(error)
print(Path("run/part").read_bytes())
"""
    code, out, err = run(code, cwd=tmp_path)
    assert code == 0, err
    assert "another process is at work" in out
