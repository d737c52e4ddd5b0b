"""RMSE and FFMDE over the density of the points at a fixed pose error: the paper's Fig. 1."""

from experiments.runner import study_command
from experiments.studies.density.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
