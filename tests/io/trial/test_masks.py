import cv2
import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.trial.masks import open_masks, pack_mask, unpack_mask, write_masks
from marey.io.video.video_writer import VideoWriter


@pytest.mark.parametrize("size", [(48, 64), (7, 5), (1, 3)])
def test_silhouettes_are_read_in_any_order(tmp_path, rng, size):
    masks = rng.random((9, *size)) > 0.5
    path = tmp_path / "masks" / "cam01.npz"
    write_masks(path, iter(masks), shape=masks.shape)
    found = open_masks(path, shape=masks.shape)
    assert np.array_equal(list(found.masks()), masks)
    order = [8, 0, 3, 4, 4, 2]
    assert np.array_equal(list(found.masks(order)), masks[order])


@pytest.mark.parametrize("size", [(48, 64), (7, 5)])
def test_the_file_is_what_numpy_would_have_packed(tmp_path, rng, size):
    masks = rng.random((6, *size)) > 0.5
    write_masks(tmp_path / "a.npz", masks, shape=masks.shape)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert np.array_equal(file["bits"], np.packbits(masks))
        shape = file["shape"]
        assert np.array_equal(np.unpackbits(file["bits"])[: shape.prod()].reshape(shape), masks)


def test_frames_without_a_person_and_frames_never_reached_are_empty(tmp_path):
    full = np.ones((5, 7), bool)
    write_masks(tmp_path / "a.npz", [None, full], shape=(4, 5, 7))
    assert [mask.sum() for mask in open_masks(tmp_path / "a.npz").masks()] == [0, 35, 0, 0]


def test_an_interrupted_writing_leaves_no_file(tmp_path):
    def masks():
        yield np.zeros((5, 7), bool)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_masks(tmp_path / "a.npz", masks(), shape=(4, 5, 7))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="does not belong"):
        write_masks(tmp_path / "a.npz", [np.zeros((7, 5), bool)], shape=(4, 5, 7))


def test_a_packed_silhouette_is_restored_and_small(rng):
    mask = cv2.circle(np.zeros((480, 640), np.uint8), (300, 200), 90, 1, -1).astype(bool)
    packed = pack_mask(mask)
    assert np.array_equal(unpack_mask(packed, mask.shape), mask)
    assert len(packed) < 2000
    odd = rng.random((7, 5)) > 0.5
    assert np.array_equal(unpack_mask(pack_mask(odd), (7, 5)), odd)


@pytest.mark.parametrize("bright", [1, 255])
def test_an_image_is_the_silhouette_of_a_single_frame(tmp_path, bright):
    picture = np.zeros((5, 7), np.uint8)
    picture[2, 3:5] = bright
    cv2.imwrite(str(tmp_path / "cam01.png"), picture)
    found = open_masks(tmp_path / "cam01.png", shape=(1, 5, 7))
    assert np.array_equal(next(found.masks()), picture > 0)
    with pytest.raises(FileProblem, match="has 1 frames of 7 x 5, but the video has 10 of 7 x 5"):
        open_masks(tmp_path / "cam01.png", shape=(10, 5, 7))


def test_wrong_files_are_rejected(tmp_path, rng):
    path = tmp_path / "cam01.npz"
    np.savez(path, shape=[2, 5, 7])
    with pytest.raises(FileProblem, match=r"cam01.npz: has no bits. It should contain shape"):
        open_masks(path)
    np.savez(path, shape=[5, 7], bits=np.zeros(5, np.uint8))
    with pytest.raises(FileProblem, match="is not \\(frames, height, width\\)"):
        open_masks(path)
    path.write_bytes(b"nothing")
    with pytest.raises(FileProblem, match="cannot be read as silhouettes"):
        open_masks(path)
    np.savez(path, shape=[4, 5, 7], bits=np.zeros(5, np.uint8))
    with pytest.raises(FileProblem, match=r"has bits of shape \(5,\) .* not those of 4 x 5 x 7"):
        open_masks(path)
    write_masks(path, rng.random((50, 40, 40)) > 0.5, shape=(50, 40, 40))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(FileProblem, match="is damaged"):
        list(open_masks(path).masks())


def test_a_mask_of_the_shared_figure_is_a_person(shared):
    path = shared / "data/surface/figure20/masks/cam01.png"
    assert 0.01 < next(open_masks(path).masks()).mean() < 0.5


def grey_images(rng, count=6, size=(48, 64)):
    """Return smooth grey images (count, height, width), which a video keeps approximately."""
    coarse = rng.integers(0, 256, (count, 3, 4)).astype(np.uint8)
    return np.stack([cv2.resize(each, size[::-1], interpolation=cv2.INTER_CUBIC) for each in coarse])


def test_a_folder_of_images_holds_probabilities_in_the_order_of_their_numbers(tmp_path, rng):
    levels = grey_images(rng, count=12)
    folder = tmp_path / "cam01"
    folder.mkdir()
    for number, image in enumerate(levels):
        cv2.imwrite(str(folder / f"view2_{number}.png"), image)
    (folder / "notes.txt").touch()
    found = open_masks(folder, shape=levels.shape)
    assert np.array_equal(list(found.levels(range(12))), levels)
    assert np.array_equal(list(found.levels([11, 2])), levels[[11, 2]])
    assert np.array_equal(list(found.masks()), levels > 127)
    assert len(found.paths) == 12
    (folder / "view2_7.png").unlink()
    with pytest.raises(FileProblem, match="cam01: has 11 frames of 64 x 48, but the video has 12 of 64 x 48"):
        open_masks(folder, shape=levels.shape)
    with pytest.raises(FileProblem, match="has 11 frames of 64 x 48, but the video has 11 of 32 x 24"):
        open_masks(folder, shape=(11, 24, 32))


def test_images_without_or_with_repeated_numbers_are_rejected(tmp_path):
    folder = tmp_path / "cam01"
    folder.mkdir()
    with pytest.raises(FileProblem, match="cam01: has no PNG image"):
        open_masks(folder)
    cv2.imwrite(str(folder / "a_01.png"), np.zeros((5, 7), np.uint8))
    cv2.imwrite(str(folder / "b_1.png"), np.zeros((5, 7), np.uint8))
    with pytest.raises(FileProblem, match=r"b_1.png: has the same number as a_01.png"):
        open_masks(folder)
    (folder / "b_1.png").rename(folder / "last.png")
    with pytest.raises(FileProblem, match=r"last.png: has no number at the end of its name"):
        open_masks(folder)


def test_an_image_of_another_size_in_a_folder_is_rejected(tmp_path):
    folder = tmp_path / "cam01"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.zeros((5, 7), np.uint8))
    cv2.imwrite(str(folder / "1.png"), np.zeros((5, 8), np.uint8))
    with pytest.raises(FileProblem, match=r"1.png: has the size 8 x 5"):
        list(open_masks(folder, shape=(2, 5, 7)).masks())


def test_a_grey_video_holds_probabilities(tmp_path, rng):
    levels = grey_images(rng)
    path = tmp_path / "cam01.mp4"
    with VideoWriter(path, (64, 48), rate=30) as video:
        for image in levels:
            video.add(np.repeat(image[..., None], 3, axis=2))
    found = open_masks(path, shape=levels.shape)
    read = np.stack(list(found.levels(range(6)))).astype(int)
    assert np.abs(read - levels).mean() < 6
    assert np.array_equal(list(found.masks([4])), read[[4]] > 127)


def test_a_silhouette_is_certain_at_every_pixel(tmp_path, rng):
    masks = rng.random((3, 5, 7)) > 0.5
    write_masks(tmp_path / "cam01.npz", masks, shape=masks.shape)
    assert np.array_equal(list(open_masks(tmp_path / "cam01.npz").levels([0, 2])), masks[[0, 2]] * 255)
