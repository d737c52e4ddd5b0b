"""Registers real scans without guess or training, against ground truth."""

from experiments.runner import study_command
from experiments.studies.real_scans.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
