"""The errors that a user can cause; commands print them as one line and exit with status 2."""


class EispError(Exception):
    """A mistake in the input or the surroundings; its text names the value and the choices."""


class DataError(EispError):
    """A dataset, an episode or an array that is not what it should be."""


class ConfigError(EispError):
    """A flag, a name or a combination of settings that cannot be used."""


class RobotError(EispError):
    """A robot or a camera that does not answer, refuses, or may not do what it was asked."""
