"""Version of the package: released, kept with every comparison, and part of a run's key."""

__version__ = "0.2.0"
