"""Records and is killed, again and again: run by the test, in a process of its own.

    python kill_recorders.py STEPS FOLDER KILLS SEED

Each recorder is a fork of this process (which has imported everything) and gets a session in
real time: every 20 ms a read of the port that says its number and when it was handed over, now and
then what was decoded and estimated. After a random time it is killed with SIGKILL. What it had
handed over by then stands in a page of shared memory; printed, one line of JSON a kill: file,
number and time of the last one handed over.
"""

import itertools
import json
import mmap
import os
import pickle
import random
import signal
import struct
import sys
import time
from pathlib import Path

from relpos.recording.about import About
from relpos.recording.recorder import Recorder
from relpos.recording.schemas import all_topics

PAGE = struct.Struct("<Qd")
EVERY_S = 0.02
LONGEST_S = 4.0


def record(path, steps, page):
    started_ns, started_s = time.time_ns(), time.monotonic()
    recorder = Recorder(path, About(started_ns))
    for number in itertools.count(1):
        _, data, observations, estimates = steps[number % len(steps)]
        arrival_s = time.monotonic() - started_s
        page[: PAGE.size] = PAGE.pack(number, arrival_s)
        recorder.received(arrival_s, struct.pack("<Q", number) + data)
        recorder.observed(arrival_s, observations)
        for estimate in estimates:
            recorder.estimated(estimate)
        time.sleep(EVERY_S)


def main():
    steps_file, folder, kills, seed = sys.argv[1:]
    steps = pickle.loads(Path(steps_file).read_bytes())
    all_topics()  # Loads Foxglove's schemas.
    dice = random.Random(int(seed))
    for k in range(int(kills)):
        path = Path(folder) / f"{k}.mcap"
        page = mmap.mmap(-1, mmap.PAGESIZE)
        child = os.fork()
        if not child:
            record(path, steps, page)
        time.sleep(dice.uniform(0.0, LONGEST_S))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        number, arrival_s = PAGE.unpack(page[: PAGE.size])
        print(json.dumps({"path": str(path), "number": number, "arrival_s": arrival_s}), flush=True)


if __name__ == "__main__":
    main()
