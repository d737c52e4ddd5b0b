"""Section IV of the paper on a virtual stand: how truly turns and moves are recognised."""

from experiments.runner import study_command
from experiments.studies.position.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
