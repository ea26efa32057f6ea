"""Schedules of motion and gains: rows, checks, files. They load where only NumPy is installed."""

from torch_pbd.control.schedule.schedule import Schedule

__all__ = ["Schedule"]
