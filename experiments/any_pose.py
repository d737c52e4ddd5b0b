"""The guide vane from uniformly random rotations, without an initial guess."""

from experiments.runner import study_command
from experiments.studies.any_pose.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
