"""Scan sets: thinning, labels, the split, and files that cannot be trusted."""

import numpy as np
import pytest
import trimesh

from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.files import read_arrays, write_arrays
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.training.dataset import ScanSet, describe_source, load_scan_set, make_scan_set

VOXEL_MM = 3.0
CAMERA = Camera().scaled(0.2)


@pytest.fixture(scope="module")
def part() -> Part:
    box = trimesh.creation.box((60.0, 40.0, 20.0))
    box.apply_translation((5.0, -3.0, 11.0))
    return part_from_mesh(box.vertices, box.faces, name="box")


@pytest.fixture(scope="module")
def scans(part: Part) -> ScanSet:
    views = hemisphere_viewpoints(
        part.center, elevations_deg=(60.0, 85.0), azimuths_deg=(0, 10, 40)
    )
    return make_scan_set(part, CAMERA, views, voxel_mm=VOXEL_MM, progress=False)


def test_labels_bring_scans_onto_the_part(part: Part, scans: ScanSet) -> None:
    part_from_camera = scans.viewpoints.camera_from_part.inverse()
    moved = part_from_camera.apply(scans.points.astype(np.float64))
    for view, count in enumerate(scans.counts):
        # signed distance of a box: outside by its positive parts, inside by its largest
        beyond = np.abs(moved[view, :count] - part.center) - part.extent_mm / 2
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        distance = outside + np.abs(np.minimum(beyond.max(axis=1), 0))
        assert distance.max() < 1e-3  # f32 points 400 mm away: half a ulp is 1.5e-5 mm


def test_normals_are_outward_unit_vectors_of_the_part(part: Part, scans: ScanSet) -> None:
    normals = scans.viewpoints.camera_from_part.inverse().rotate(scans.normals.astype(np.float64))
    real = np.arange(normals.shape[1])[None, :] < scans.counts[:, None]
    # a box: each normal is plus or minus a unit axis
    largest = np.abs(normals[real]).max(axis=1)
    np.testing.assert_allclose(largest, 1.0, atol=1e-6)  # f32 eps x 10
    assert (scans.normals[real][:, 2] > 0).all()  # towards the camera, whose +z is towards it


def test_one_point_per_voxel(scans: ScanSet) -> None:
    points = scans.points[0, : scans.counts[0]]
    cells = np.floor(points.astype(np.float64) / VOXEL_MM).astype(int)
    assert len(np.unique(cells, axis=0)) == len(points)


def test_a_box_shows_about_its_visible_share(part: Part, scans: ScanSet) -> None:
    # From elevation 60, azimuth 0 the top, 60 x 40, and the +x side, 40 x 20, are seen.
    index = int(np.argmin(scans.viewpoints.elevation_deg))
    expected = (60 * 40 + 40 * 20) / part.mesh.area
    # both grids cut the surfaces at angles of their own, and edges cross voxels unevenly
    assert scans.visible_fraction[index] == pytest.approx(expected, rel=0.2)


def test_the_split_is_by_azimuth(scans: ScanSet) -> None:
    assert sorted(set(scans.test.viewpoints.azimuth_deg)) == [0.0, 40.0]
    assert sorted(set(scans.train.viewpoints.azimuth_deg)) == [10.0]
    assert len(scans.train) + len(scans.test) == len(scans) == 6


def test_round_trip_keeps_every_bit(scans: ScanSet, tmp_path) -> None:
    scans.save(tmp_path / "scans.npz")
    again = load_scan_set(tmp_path / "scans.npz", expected=scans.source)
    for name, value in scans._arrays().items():
        np.testing.assert_array_equal(again._arrays()[name], value, err_msg=name)
    assert again.radius_mm == scans.radius_mm
    assert dict(again.source) == dict(scans.source)
    assert [path.name for path in tmp_path.iterdir()] == ["scans.npz"]


def test_a_stale_file_names_what_differs(part: Part, scans: ScanSet, tmp_path) -> None:
    scans.save(tmp_path / "scans.npz")
    expected = describe_source(part, CAMERA, scans.viewpoints, voxel_mm=2.0)
    with pytest.raises(InputError, match=r"stale: made with voxel_mm = 3\.0, wanted 2\.0"):
        load_scan_set(tmp_path / "scans.npz", expected=expected)
    other = part_from_mesh(part.mesh.vertices * 1.01, part.mesh.faces, name="box")
    expected = describe_source(other, CAMERA, scans.viewpoints, VOXEL_MM)
    with pytest.raises(InputError, match="stale: made with part_sha256"):
        load_scan_set(tmp_path / "scans.npz", expected=expected)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda arrays, header: header.clear(), "not a scan set of vanejax; delete"),
        (lambda arrays, header: header.update(version=99), "of version 99, this program reads 1"),
        (lambda arrays, header: header.pop("source"), "its header has no source"),
        (lambda arrays, header: arrays.pop("points"), r"not a whole scan set \('points'\)"),
        (lambda arrays, header: arrays.update(counts=arrays["counts"][1:]), "do not fit together"),
        (lambda arrays, header: arrays.update(counts=0 * arrays["counts"]), "do not fit together"),
    ],
)
def test_a_changed_file_is_refused_by_what_changed(scans, tmp_path, change, words: str) -> None:
    path = tmp_path / "scans.npz"
    scans.save(path)
    arrays, header = read_arrays(path)
    change(arrays, header)
    write_arrays(path, arrays, header)
    with pytest.raises(InputError, match=words):
        load_scan_set(path)


def test_a_voxel_that_leaves_nothing_is_refused(part: Part, scans: ScanSet) -> None:
    views = scans.viewpoints.select(slice(0, 1))
    with pytest.raises(InputError, match="take a smaller voxel"):
        make_scan_set(part, CAMERA, views, voxel_mm=50.0, progress=False)
    with pytest.raises(InputError, match="voxel_mm must be positive"):
        make_scan_set(part, CAMERA, views, voxel_mm=0.0, progress=False)
