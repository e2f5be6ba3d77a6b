"""All sources by name: the one place that knows them.

Each is imported when it is chosen: a synthetic scene needs neither PortAudio nor libsndfile.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from importlib import import_module

from locagen_edge.framing import Tap
from locagen_edge.settings import Settings
from locagen_edge.types import Frame

SOURCES = {
    "alsa": ("locagen_edge.stages.mic", "alsa"),
    "wav": ("locagen_edge.stages.mic", "wav"),
    "sim": ("locagen_edge.sim.scene", "sim"),
}


def open_source(settings: Settings, tap: Tap | None = None) -> AsyncGenerator[Frame, None]:
    """Frames from `audio.source`, in real time; `tap` hears the sound before it is cut. Close it: `aclose()`.

    While it is read it raises `SourceError` when the source cannot be opened or fails: open it anew, a little
    later. `SourceHungError`, a child of it, means that only a new process helps.
    """
    module, name = SOURCES[settings.audio.source]
    source: Callable[[Settings, Tap | None], AsyncGenerator[Frame, None]]
    source = getattr(import_module(module), name)
    return source(settings, tap)
