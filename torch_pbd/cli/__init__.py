"""The command line: ``torch-pbd demo``, ``fit`` and so on."""
