"""A virtual casting line: how registration and its bounds stand what castings differ by.

See `experiments.studies.castings`.
"""

from experiments.runner import study_command
from experiments.studies.castings.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
