"""The backends that measurements compare when none is named."""

DEFAULT_BACKENDS = ("hpc", "gears")
