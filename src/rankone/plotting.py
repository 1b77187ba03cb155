"""Plots of a solution: its values, statistics and base functions, and how it was found.

They need Matplotlib: ``pip install matplotlib``, or ``pip install ".[plot]"`` in the folder of the
sources.

Nothing is shown: ``ax.figure.savefig("name.png")`` writes a figure, ``matplotlib.pyplot.show()``
shows it. All draw into the axes given as ``ax``, or into those of a new figure, and return them,
those with several panels an array of them.
"""

from rankone.share.plotting import *  # noqa: F403
from rankone.share.plotting import __all__ as __all__
