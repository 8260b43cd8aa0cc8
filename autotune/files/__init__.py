"""Files as engineers have them: what is read from them, and how it was found out."""

from autotune.files.reading import Reading, read_recordings
from autotune.files.signal_names import SignalNames

__all__ = ["Reading", "SignalNames", "read_recordings"]
