"""The few errors and warnings of this package that Python and scikit-learn do not have."""


class InvalidParameterError(ValueError, TypeError):
    """An argument has a type or a value that cannot be used; the message names it, and says what it must be."""


class NotPositiveDefiniteError(ValueError):
    """A matrix that must be positive definite is not, even with the largest jitter allowed."""


class ModelFileError(ValueError):
    """A model file is damaged, of a newer version, or not a model of this package."""


class DataRankWarning(UserWarning):
    """The data leave directions of the covariance undetermined; a documented fallback was used."""


class MissingDataWarning(UserWarning):
    """Samples with missing values were dropped, as was asked for."""


class UnimodalityWarning(UserWarning):
    """The demonstrations follow more than one way, or one of them is far from the others."""


class DataFormatError(ValueError):
    """A file of demonstrations cannot be read as what its suffix says."""


class ConfigError(ValueError):
    """A configuration file or a command line cannot be used."""


class FolderInUseError(RuntimeError):
    """Another run writes the folder of results."""
