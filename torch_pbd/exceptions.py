"""Errors and warnings of this package."""


class InvalidParameterError(ValueError, TypeError):
    """Error for an invalid type or value of an argument; the message names it and what it must be."""


class NotPositiveDefiniteError(ValueError):
    """Error for a matrix that is not positive definite, even with the largest jitter allowed."""


class ModelFileError(ValueError):
    """Error for a file that is damaged, of a newer version, or not of this package."""


class DataRankWarning(UserWarning):
    """Warning that the data leave directions of the covariance undetermined and a fallback was used."""


class MissingDataWarning(UserWarning):
    """Warning that samples with missing values were dropped, as requested."""


class UnimodalityWarning(UserWarning):
    """Warning that the demonstrations have several modes, or one of them is far from the others."""


class DataFormatError(ValueError):
    """Error for a file of demonstrations that does not match its suffix."""


class ConfigError(ValueError):
    """Error for an invalid configuration file or command line."""


class FolderInUseError(RuntimeError):
    """Error for a results folder that another run is writing."""
