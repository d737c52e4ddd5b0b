"""The grammar of sweeps, and the cells of the grid they span."""

import itertools

import pytest

from experiments.configs.smoke import get_config
from experiments.runner.sweep import Cell, Sweep, grid, parse_seeds, parse_sweeps
from vanejax.errors import InputError


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("model.num_neighbors=8,16,32", (8, 16, 32)),
        ("config.model.num_neighbors=8", (8,)),
        ("data.noise=0, 5e-3,1", (0.0, 0.005, 1.0)),
        ("training.quick_compilation=true,False", (True, False)),
        ("data.shapes=,solids,'a,b.npz'", ("", "solids", "a,b.npz")),
        ("views.azimuths_deg=(0,20),[0,40,60],()", ((0.0, 20.0), (0.0, 40.0, 60.0), ())),
        ("model.name=rpmnet,dcp", ("rpmnet", "dcp")),
    ],
)
def test_values_have_the_type_of_their_field(word: str, values: tuple) -> None:
    (sweep,) = parse_sweeps([word], get_config())
    assert repr(sweep.values) == repr(values)  # 8 is not 8.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "--sweep is missing"),
        (["model.num_neighbors"], "should be FIELD=VALUE"),
        (["model.num_neighbours=8"], r"--sweep model.num_neighbours: .*mean num_neighbors\?"),
        (["model=8"], "model is a group.*num_neighbors"),
        (["model.num_neighbors=8,abc"], "model.num_neighbors: 'abc' .*takes an int, for example"),
        (["model.num_neighbors=8.0"], "'8.0' .* an int"),
        (["model.num_neighbors="], "'' .* an int"),
        (["data.noise=0,nan"], "'nan' .* a float"),
        (["training.quick_compilation=1"], "'1' .* a bool"),
        (["views.azimuths_deg=40"], "'40' .* a tuple"),
        (["views.azimuths_deg=(0,x)"], r"'\(0,x\)' .* a tuple"),
        (["views.azimuths_deg=(0,20"], "a bracket is not closed"),
        (["data.shapes='a"], "a quote is not closed"),
        (["data.noise=0.01,0.02,1e-2"], "0.01 is there twice"),
        (["data.noise=0", "data.noise=0.01"], "data.noise: given twice"),
        (["seed=0,1"], "--seeds 0,1,2"),
    ],
)
def test_a_wrong_sweep_says_what_is_wrong(words: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_sweeps(words, get_config())


def test_seeds_are_whole_numbers_each_once() -> None:
    assert parse_seeds(["2", "0"], default=7) == (2, 0)
    assert parse_seeds([], default=7) == (7,)
    for words in (["-1"], ["1.5"], ["a"]):
        with pytest.raises(InputError, match="whole number"):
            parse_seeds(words, default=0)
    with pytest.raises(InputError, match="1 is there twice"):
        parse_seeds(["1", "01"], default=0)


def test_a_grid_holds_every_combination_once() -> None:
    sweeps = [Sweep("model.num_neighbors", (4, 8, 16)), Sweep("data.noise", (0.0, 0.01))]
    cells = grid(sweeps, (0, 3))
    expected = {
        ((("data.noise", noise), ("model.num_neighbors", k)), seed)
        for k, noise, seed in itertools.product((4, 8, 16), (0.0, 0.01), (0, 3))
    }
    assert len(cells) == 12
    assert {(cell.overrides, cell.seed) for cell in cells} == expected
    assert set(grid(sweeps[::-1], (3, 0))) == set(cells)  # an order of sweeps is no other grid


def test_a_cell_changes_its_fields_and_nothing_else() -> None:
    base = get_config()
    cell = Cell((("data.noise", 0.02), ("views.azimuths_deg", (0.0, 20.0))), seed=3)
    config, expected = cell.config(base), get_config()
    assert base == expected
    expected.data.noise, expected.views.azimuths_deg, expected.seed = 0.02, (0.0, 20.0), 3
    assert config == expected


def test_names_are_readable_and_safe_and_differ() -> None:
    assert Cell((("data.noise", 0.005),), 1).name == "data.noise=0.005,seed=1"
    angles = tuple(map(float, range(0, 360, 10)))
    cells = [
        Cell(((field, value),), seed)
        for field, value in (
            ("part.path", "a/b.stl"),
            ("part.path", "a_b.stl"),
            ("part.path", "../b.stl"),
            ("data.shapes", ""),
            ("views.azimuths_deg", angles),
            ("views.azimuths_deg", angles[:-1]),
        )
        for seed in (0, 1)
    ]
    names = [cell.name for cell in cells]
    assert len(set(names)) == len(names)
    assert all("/" not in name and len(name) < 200 for name in names)
