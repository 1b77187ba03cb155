"""What every room uses: the version, errors, wording, files, progress, the budget of work."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rankone")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
