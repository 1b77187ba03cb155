"""One way to drive an FMU of either version of FMI, through FMPy's low-level functions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import byref, c_bool, c_double
from pathlib import Path

import fmpy
from fmpy import fmi2, fmi3

__all__ = ["Slave", "slave"]


class Slave:
    """An instance, with the messages that it logged.

    Attributes
    ----------
    references : dict
        Value references by the names of the variables.
    messages : list of str
    statuses : list of int
        Of the calls that the messages belong to.
    """

    def __init__(
        self,
        folder: Path,
        name: str = "one",
        token: str | None = None,
        logging: bool = True,
        early: bool = False,
    ) -> None:
        about = fmpy.read_model_description(str(folder))
        self.two = about.fmiVersion == "2.0"
        self.references = {v.name: v.valueReference for v in about.modelVariables}
        self.messages: list[str] = []
        self.statuses: list[int] = []
        kind = fmi2.FMU2Slave if self.two else fmi3.FMU3Slave
        self.fmu = kind(
            guid=token or about.guid or about.instantiationToken,
            unzipDirectory=str(folder),
            modelIdentifier=about.coSimulation.modelIdentifier,
            instanceName=name,
        )
        if self.two:
            callbacks = fmi2.fmi2CallbackFunctions()
            callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._log)
            callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
            callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
            self.fmu.instantiate(callbacks=callbacks, loggingOn=logging)
        else:
            self.early = early
            self.fmu.instantiate(logMessage=self._log3, loggingOn=logging, earlyReturnAllowed=early)

    def _log(self, environment, name, status, category, message) -> None:
        assert category == {2: b"logStatusDiscard", 3: b"logStatusError"}[status]
        self.messages.append(message.decode())
        self.statuses.append(status)

    def _log3(self, environment, status, category, message) -> None:
        self._log(environment, None, status, category, message)

    def begin(self, start: float = 0.0, stop: float | None = None, **values: float) -> None:
        """From the instantiation to the first step."""
        self.set(**values)
        self.enter(start, stop)
        self.fmu.exitInitializationMode()

    def enter(self, start: float, stop: float | None = None) -> None:
        if self.two:
            self.fmu.setupExperiment(startTime=start, stopTime=stop)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=start, stopTime=stop)

    def set(self, **values: float) -> None:
        references = [self.references[name] for name in values]
        function = self.fmu.setReal if self.two else self.fmu.setFloat64
        function(references, list(values.values()))

    def get(self, *names: str) -> list[float]:
        references = [self.references[name] for name in names]
        return (self.fmu.getReal if self.two else self.fmu.getFloat64)(references)

    def step(self, at: float, size: float) -> None:
        if self.two:
            self.fmu.doStep(at, size)
            return
        self.outputs = (c_bool(), c_bool(), c_bool(), c_double())
        self.fmu.fmi3DoStep(self.fmu.component, at, size, True, *map(byref, self.outputs))

    def ends(self) -> tuple[bool, float]:
        """Whether the FMU asks for the end after the last step, and the time that it reached."""
        if self.two:
            ends = self.fmu.getBooleanStatus(fmi2.fmi2Terminated)
            return bool(ends), self.fmu.getRealStatus(fmi2.fmi2LastSuccessfulTime)
        event, ends, early, reached = (value.value for value in self.outputs)
        assert not event
        assert self.early or not early
        self.returned_early = early
        return ends, reached

    def free(self) -> None:
        """Of this instance alone: FMPy would unload the library for all."""
        free = self.fmu.fmi2FreeInstance if self.two else self.fmu.fmi3FreeInstance
        free(self.fmu.component)


@contextmanager
def slave(folder: Path, *at: float, early: bool = False, **values: float) -> Iterator[Slave]:
    """An instance that is ready for the first step, freed at the end."""
    one = Slave(folder, early=early)
    try:
        one.begin(*at, **values)
        yield one
    finally:
        one.free()
