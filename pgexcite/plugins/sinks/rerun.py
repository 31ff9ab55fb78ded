"""The recording of a run: a view a person wants to look at, as a file with its layout embedded, or live."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pgexcite.core import recording
from pgexcite.core.record import RECORDING_FILE
from pgexcite.core.result import RunResult
from pgexcite.core.system import System
from pgexcite.core.trace import Trace
from pgexcite.plugins.sinks import realtime_view
from pgexcite.plugins.sinks.overview import Overview


class RerunSink:
    """Writes ``run.rrd``: every signal of the trace under its own path, and the overview drawn from them."""

    def write(self, result: RunResult, directory: Path) -> Path:
        """Write into an existing directory; returns the file written."""
        path = directory / RECORDING_FILE
        overview = Overview.of(result.system, result.trace.columns)
        stream = recording.new_stream(result.title, result.trace.columns)
        recording.save(stream, path, overview.blueprint(result.trace))
        overview.draw_fixed(stream)
        if result.timing is not None:
            realtime_view.draw(stream, result.timing)
        overview.send(stream, result.trace)
        recording.finish(stream)
        return path


class LiveView:
    """A run to watch while it goes on: rerun's own server, which buffers for viewers that come late.

    The run serves and viewers connect. The other way round, a run that connects to a viewer, stalls with it; a server was
    measured to go on at full speed without a viewer and with a dead one.
    """

    def __init__(self, stream: Any, overview: Overview, url: str) -> None:
        self.url = url
        self._stream = stream
        self._overview = overview
        self._sent = 0

    def send(self, chunk: Trace) -> None:
        """Send the samples since the last call; a chunk of a tenth of a second or more costs next to nothing."""
        self._overview.send(self._stream, chunk, first=self._sent)
        self._sent += len(chunk.t)

    def close(self) -> None:
        """Stop serving; viewers that are open keep what they have."""
        recording.finish(self._stream)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def serve(title: str, system: System, signals: Sequence[str], *, port: int = 9876, bind: str = "127.0.0.1") -> LiveView:
    """Start to serve a live view; open it with ``rerun URL``.

    Args:
        title: of the run.
        system: what is simulated.
        signals: paths of the signals the trace will have.
        port: to listen at; when something else listens there already, a free one is taken instead.
        bind: address to listen on; this machine only, unless told otherwise.

    Returns:
        The live view; ``url`` is what a viewer connects to.
    """
    import rerun as rr

    overview = Overview.of(system, signals)
    stream = recording.new_stream(title, signals)
    port = _free_port(bind, port)
    stream.set_sinks(rr.GrpcServerSink(bind_ip=bind, port=port), default_blueprint=overview.blueprint())
    overview.draw_fixed(stream)
    return LiveView(stream, overview, f"rerun+http://{bind}:{port}/proxy")


def _free_port(bind: str, wanted: int) -> int:
    """``wanted``, or any free port where it is taken: rerun itself reports a taken port on stderr only, and serves nothing."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((bind, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    return wanted
