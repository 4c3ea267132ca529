import numpy as np
import pytest
from tests.onnx_files import write_onnx

from marey.errors import FileProblem
from marey.io.trial.person_network import open_person_network

RED = np.array([[8.0, -4.0, -4.0]])
"""Weights of red, green and blue of a network to which red things are persons."""


def red_square(height: int = 60, width: int = 80) -> np.ndarray:
    """Return a blue image with a red square."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = 255
    image[20:40, 30:50] = (0, 0, 255)
    return image


def test_a_network_of_one_channel_gives_the_probability_of_a_person(tmp_path):
    network = open_person_network(write_onnx(tmp_path / "a.onnx", RED, bias=(0,), shape=(1, 3, 30, 40), end="Sigmoid"))
    assert network.size == (40, 30)
    levels = network.loaded()(red_square())
    assert levels.shape == (60, 80)
    assert levels.dtype == np.uint8
    assert levels[22:38, 32:48].min() == round(255 / (1 + np.exp(-8)))
    assert levels[:15].max() == round(255 / (1 + np.exp(4)))


def test_of_two_channels_the_second_is_the_person(tmp_path):
    weights = np.concatenate([-RED / 2, RED / 2])
    network = open_person_network(
        write_onnx(tmp_path / "a.onnx", weights, bias=(0, 0), shape=(1, 3, 30, 40), end="Identity")
    )
    levels = network.loaded()(red_square())
    assert levels[30, 40] == round(255 / (1 + np.exp(-8)))
    assert levels[5, 5] == round(255 / (1 + np.exp(4)))


def test_a_grey_image_is_seen_as_three_equal_channels(tmp_path):
    grey = np.array([[1.0, 1.0, 1.0]]) / 3
    network = open_person_network(
        write_onnx(tmp_path / "a.onnx", grey, bias=(0,), shape=(1, 3, 30, 40), end="Identity")
    )
    assert np.all(network.loaded()(np.full((30, 40, 1), 100, np.uint8)) == 100)


def test_other_networks_are_rejected(tmp_path):
    three = write_onnx(tmp_path / "a.onnx", np.eye(3), bias=(0, 0, 0), shape=(1, 3, 30, 40), end="Sigmoid")
    with pytest.raises(FileProblem, match=r"a.onnx: has an output of the shape \[1, 3, 30, 40\]. It should be"):
        open_person_network(three)
    one = write_onnx(tmp_path / "b.onnx", np.ones((1, 1)), bias=(0,), shape=(1, 1, 30, 40), end="Sigmoid")
    with pytest.raises(FileProblem, match=r"b.onnx: has an input of the shape \[1, 1, 30, 40\]. It should be"):
        open_person_network(one)
    scores = write_onnx(tmp_path / "c.onnx", RED, bias=(-9,), shape=(1, 3, 30, 40), end="Identity")
    with pytest.raises(FileProblem, match=r"c.onnx: gives values from -9 to -9, which are no probabilities"):
        open_person_network(scores)


@pytest.mark.parametrize("name", ["a.tflite", "a.onnx"])
def test_a_file_that_is_no_network_is_rejected(tmp_path, capfd, name):
    path = tmp_path / name
    path.write_bytes(b"no network" * 20)
    with pytest.raises(FileProblem, match=f"{name}: is no network that OpenCV can read") as caught:
        open_person_network(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_an_operator_whose_name_is_damaged_is_rejected(tmp_path):
    path = write_onnx(tmp_path / "a.onnx", np.ones((1, 3)), bias=(0,), shape=(1, 3, 8, 8), end="Sigmoid")
    whole = path.read_bytes()
    for wrong in (b"Sig\x93\x9aid", b"Higmoid"):
        # OpenCV lists the inputs of an operator that it does not know.
        path.write_bytes(whole.replace(b"Sigmoid", wrong).replace(b"\n\x01y\x12\x01z", b"\n\x01\xa7\x12\x01z"))
        with pytest.raises(FileProblem, match=r"a.onnx: has an operator whose name or inputs are damaged"):
            open_person_network(path)


def test_another_extension_is_rejected(tmp_path):
    (tmp_path / "a.pt").touch()
    with pytest.raises(FileProblem, match=r"a.pt: has the extension '.pt', which is neither"):
        open_person_network(tmp_path / "a.pt")


@pytest.mark.parametrize(
    ("name", "size"),
    [("selfie_segmentation.tflite", (256, 256)), ("selfie_segmentation_landscape.tflite", (256, 144))],
)
def test_a_published_network_finds_the_person(shared, name, size):
    path = shared / "data" / "nets" / name
    if not path.exists():
        pytest.skip(f"../shared/data/nets/{name} is missing")
    network = open_person_network(path)
    assert network.size == size
    assert network.loaded()(np.zeros((48, 64, 3), np.uint8)).max() < 128
