"""The run format's files, written while the session runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from relpos.fusion.estimator import Estimate
from relpos.live.log_files import log_row
from relpos.live.sinks import Sink
from relpos.live.team_view import LogEntry
from relpos.measurements import Observation, Prior, Step, common_priors
from relpos.runs import Description, EstimateFiles, RunFiles, drop_page
from relpos.runs.appending import AppendedTable
from relpos.runs.log import LOG_COLUMNS, LOG_FILE
from relpos.runs.run import RECEIVED
from relpos.said import Said


class FileSink(Sink):
    """Writes estimates to ``directory``, and received observations to its ``received/``.

    Reports a full disk through ``trouble``; rows wait in memory until it accepts them.
    """

    def __init__(
        self,
        directory: Path,
        description: Description,
        priors: Sequence[Prior] | None = None,
        *,
        common: bool = False,
        keep_received: bool = True,
    ) -> None:
        self._description = description
        drop_page(directory)
        self._estimates = EstimateFiles(directory, priors)
        self._common = common
        self._begun: set[int] = set()
        """Nodes that have been found to start at the common pose."""
        self._log = AppendedTable(directory / LOG_FILE, LOG_COLUMNS, wanted=False)
        self._received = RunFiles(directory / RECEIVED, description) if keep_received else None
        self._undescribed: OSError | None = None
        """Why the newest names are not in run.toml yet."""

    def named(self, names: Mapping[int, str]) -> None:
        """Store the wearers' names."""
        if self._received is None:
            return
        self._description = self._description.with_names(names)
        self._describe()

    def _describe(self) -> None:
        if self._received is None:
            return
        try:
            self._received.describe(self._description)
        except OSError as error:
            self._undescribed = error
        else:
            self._undescribed = None

    def observed(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        """Write observations."""
        self._estimates.write_steps([o for o in observations if isinstance(o, Step)])
        if self._received is not None:
            self._received.write(observations)

    def estimated(self, estimate: Estimate) -> None:
        """Write an estimate."""
        if self._common:
            new = [n.node for n in estimate.nodes if n.node not in self._begun]
            self._begun.update(new)
            self._estimates.write_initial(common_priors(new))
        self._estimates.write(estimate)

    def logged(self, entry: LogEntry) -> None:
        """Write a line of the log."""
        self._log.add([log_row(entry)])

    def trouble(self) -> str | None:
        """Write what has waited long enough; return the first file that cannot be, and why."""
        received = () if self._received is None else self._received.tables
        tables = (*self._estimates.tables, self._log, *received)
        for table in tables:
            table.tick()
        for table in tables:
            if table.error is not None:
                why = table.error.strerror or str(table.error)
                if not table.lost_rows:
                    return Said(
                        "rows-wait",
                        "{file}: {why}: its rows wait in memory",
                        file=str(table.path),
                        why=why,
                    )
                return Said(
                    "rows-lost",
                    "{file}: {why}: its rows wait in memory; {count} rows are lost",
                    file=str(table.path),
                    why=why,
                    count=table.lost_rows,
                )
        if self._undescribed is not None:
            why = self._undescribed.strerror or str(self._undescribed)
            file = str(self._undescribed.filename)
            return Said("names-wait", "{file}: {why}: names wait in memory", file=file, why=why)
        return None

    def close(self) -> None:
        """Finish the files; OSError where one could not be written."""
        try:
            if self._undescribed is not None:
                self._describe()
            if self._received is not None:
                self._received.close()
        finally:
            try:
                self._log.close()
            finally:
                self._estimates.close()
        if self._undescribed is not None:
            raise self._undescribed
