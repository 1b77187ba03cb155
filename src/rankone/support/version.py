"""The version of the library."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rankone")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
