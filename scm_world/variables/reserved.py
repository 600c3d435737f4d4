"""Names of variables that mean the same in every world that has them."""

CONTROL_INDEX = "control_index"
"""Control steps since the start of the episode."""

PRESET = "timestep_preset"
"""How finely time is cut; everything that moves depends on it."""

ACTUATOR_NOISE = "actuator_noise"
"""Standard deviation of a command, as a fraction of half the range of an action."""

SENSOR_NOISE = "sensor_noise"
"""Standard deviation of every observed number, as a fraction of half its range."""
