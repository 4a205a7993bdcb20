"""How PlatformIO runs the suites of this folder: Unity's output, on this computer and on simavr.

PlatformIO's own Unity parser reads the lines that `support/check.h` prints. Three things differ
from its Unity runner: no library is fetched, a simulated board is not uploaded to, and a program
that falls silent, dies or ends before its closing line is an error (PlatformIO would call what had
passed until then a success).
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
from pathlib import Path

from platformio.test.exception import UnitTestError
from platformio.test.runners.readers.native import NativeTestOutputReader
from platformio.test.runners.readers.serial import SerialTestOutputReader
from platformio.test.runners.unity import UnityTestRunner

# The slowest suite needs about ten seconds on simavr; a suite that hangs must not hold up the rest.
TIME_LIMIT_S = 120.0

CLOSING_LINE = re.compile(r"(\d+) Tests (\d+) Failures (\d+) Ignored")


class CustomTestRunner(UnityTestRunner):
    """Runs one suite in one environment."""

    EXTRA_LIB_DEPS = None
    closing: re.Match[str] | None = None
    restarted = False

    def configure_build_env(self, env):
        """Build the suite as it is: there is no Unity to configure."""
        return env

    def setup(self):
        """Keep avrdude away from a board that is only simulated."""
        if self.testing_command():
            self.options.without_uploading = True

    def testing_command(self):
        """Return the command of the environment that runs the program, if it has one."""
        return self.project_config.get(
            f"env:{self.test_suite.env_name}", "test_testing_command", None
        )

    def stage_testing(self):
        """Run the program and insist on its closing line."""
        if self.options.without_testing:
            return
        print("Testing...", flush=True)
        if self.platform.is_embedded() and not self.testing_command():
            SerialTestOutputReader(self).begin()
        else:
            self.run_program(NativeTestOutputReader(self).get_testing_command())
        if self.closing is None:
            raise UnitTestError("The program ended before its closing line")
        stated = int(self.closing[1])
        seen = len(self.test_suite.cases)
        if stated != seen or stated == 0:
            raise UnitTestError(f"The closing line counts {stated} tests, its output shows {seen}")

    def run_program(self, command: list[str]) -> None:
        """Feed the program's output to the parser, at most TIME_LIMIT_S long."""
        environment = dict(os.environ)
        if "tool-simavr" in self.platform.packages:
            simulator = self.platform.get_package_dir("tool-simavr")
            if simulator:
                environment["PATH"] = f"{Path(simulator) / 'bin'}{os.pathsep}{environment['PATH']}"
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment,
            )
        except FileNotFoundError as error:
            raise UnitTestError(f"{command[0]} is not installed") from error
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            process.kill()

        timer = threading.Timer(TIME_LIMIT_S, expire)
        timer.start()
        try:
            assert process.stdout is not None
            for line in process.stdout:
                self.on_testing_data_output(line)
                if self.restarted:
                    process.kill()
                    break
            status = process.wait()
        finally:
            timer.cancel()
        if self.restarted:
            raise UnitTestError("The program crashed and started again")
        if expired.is_set():
            raise UnitTestError(f"The program did not end within {TIME_LIMIT_S:.0f} s")
        # The programs return the number of failures; those have their own lines.
        if status and (self.closing is None or int(self.closing[2]) == 0):
            raise UnitTestError(f"The program ended with status {status}")

    def on_testing_line_output(self, line):
        """Do what Unity's parser does, remember the closing line and notice a second beginning."""
        if not self.restarted:
            self.closing = CLOSING_LINE.search(line or "") or self.closing
            super().on_testing_line_output(line)

    def parse_test_case(self, line):
        """Parse a test's line; a crash of an AVR shows as a test that is reported twice."""
        case = super().parse_test_case(line)
        if case and any(case.name == other.name for other in self.test_suite.cases):
            self.restarted = True
            return None
        return case
