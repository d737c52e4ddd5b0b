"""Fine registration against the Cramer-Rao bound, over views of the guide vane and noise levels."""

from experiments.runner import study_command
from experiments.studies.fine.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
