"""Options of commands: from YAML and command lines to values and objects, or to one line that says where and why."""

from torch_pbd.options.sources import Option, Options

__all__ = ["Option", "Options"]
