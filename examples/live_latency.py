"""Measure the live server's latency from sample to position, with several phones at once.

Starts a server and, for each phone, a replay of the demonstration at 100 Hz and true speed, pushed
five times a second as Sensor Logger does. Prints the time from the newest sample that a position
depends on to the event from which a page draws it, and the server's processor and memory use:

    python examples/live_latency.py [--phones 4] [--seconds 10]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median, quantiles

from replay_live import replay

from stario.fusion import demonstration
from stario.sequences import ImuSequence


@dataclass(frozen=True)
class Measured:
    """Latency and cost of the server.

    Attributes:
        latencies: (n,) times from a sample to the event with its position [s].
        cpu_share: processor time as a share of one core.
        memory_mb: resident memory at the end [MB].
    """

    latencies: list[float]
    cpu_share: float
    memory_mb: float


def main(phones: int = 4, seconds: float = 10.0) -> Measured:
    """Replay on several phones against a server in a separate process."""
    full = demonstration()
    recording = replace(
        full, time=full.time[::2], gyro=full.gyro[::2], accel=full.accel[::2], truth=None
    )
    with tempfile.TemporaryDirectory() as folder:
        stario = str(Path(sys.executable).with_name("stario"))
        command = [stario, "live", "--port", "0", "--out", folder]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
            try:
                return _measure(server, recording, phones, seconds)
            finally:
                server.send_signal(signal.SIGINT)


def _measure(
    server: subprocess.Popen[str], recording: ImuSequence, phones: int, seconds: float
) -> Measured:
    url = _address(server)
    began: dict[str, float] = {}
    latencies: list[float] = []
    threading.Thread(target=_listen, args=(url, began, latencies), daemon=True).start()
    walks = []
    for name in (f"phone {number}" for number in range(phones)):
        walk = (recording, f"{url}/data", 1.0, seconds, name)
        walks.append(threading.Thread(target=replay, args=walk))
        began[name] = time.time()
        walks[-1].start()
    before, start = _cpu_seconds(server.pid), time.monotonic()
    for thread in walks:
        thread.join()
    share = (_cpu_seconds(server.pid) - before) / (time.monotonic() - start)
    return Measured(list(latencies), share, _memory_mb(server.pid))


def _address(server: subprocess.Popen[str]) -> str:
    """Return the address that the server prints."""
    assert server.stderr is not None
    for line in server.stderr:
        found = re.search(r"http://127\.0\.0\.1:\d+", line)
        if found:
            return found[0]
    raise RuntimeError("the server printed no address")


def _listen(url: str, began: dict[str, float], latencies: list[float]) -> None:
    """Record the latency of each event, whose points carry seconds since the first sample."""
    with urllib.request.urlopen(f"{url}/events") as events:
        for line in events:
            if line.startswith(b"data:"):
                now = time.time()
                for device in json.loads(line[5:]).get("devices", []):
                    if device["points"]:
                        latencies.append(now - began[device["id"]] - device["points"][-1][0])


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory_mb(pid: int) -> float:
    [line] = [x for x in Path(f"/proc/{pid}/status").read_text().splitlines() if "VmRSS" in x]
    return int(line.split()[1]) / 1024.0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure the latency of the live server.")
    parser.add_argument("--phones", type=int, default=4, choices=range(1, 51))
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the walk [s]")
    options = parser.parse_args()
    if not options.seconds >= 3.0:  # the first position comes a second after the first sample
        parser.exit(2, f"--seconds: found {options.seconds:g}, expected at least 3\n")
    found = main(options.phones, options.seconds)
    print(
        f"{options.phones} phones at 100 Hz: sample to event {median(found.latencies):.2f} s "
        f"(median), {quantiles(found.latencies, n=20)[-1]:.2f} s (95th percentile); "
        f"{found.cpu_share:.0%} of a core, {found.memory_mb:.0f} MB"
    )
