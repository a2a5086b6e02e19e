"""Each image is either a training or a held-out image; blocks follow the order of capture."""

import re
from itertools import chain

import numpy as np
import pytest
from wording import check_error, check_text

from pcbench.scenes.splits import capture_order, hold_out, split_blocks, split_every


def image_names(count):
    return tuple(f"{k}.jpg" for k in range(count))


def circle_positions(count):
    """Return positions (count, 3) on two circles around a scene, the second one higher."""
    angles = np.linspace(0, 4 * np.pi, count, endpoint=False)
    return np.stack([50 * np.cos(angles), 50 * np.sin(angles), 10.0 * (angles >= 2 * np.pi)], axis=1)


@pytest.mark.parametrize("count", [9, 16, 17, 33, 64, 100, 257])
@pytest.mark.parametrize("blocks", [1, 2, 5, 8, 11])
def test_every_image_is_used_once(count, blocks):
    names = image_names(count)
    splits = [split_every(names), split_every(names, 3)]
    if count >= 4 * blocks + count // 8 + blocks:
        splits.append(split_blocks(names, blocks))
    for split in splits:
        assert sorted(chain(split.train, split.test)) == sorted(names)
        assert len(split.train) >= len(split.test) > 0
        assert list(split.train) == [name for name in names if name in set(split.train)]


@pytest.mark.parametrize(("count", "blocks", "share"), [(32, 8, 1 / 8), (100, 8, 1 / 8), (61, 5, 0.3), (400, 8, 0.25)])
def test_blocks_are_contiguous_separate_and_evenly_spaced(count, blocks, share):
    split = split_blocks(image_names(count), blocks, share)
    block_numbers = [[int(name.removesuffix(".jpg")) for name in block] for block in split.blocks]
    assert len(block_numbers) == blocks
    length = max(2, round(share * count / blocks))
    for block in block_numbers:
        assert block == list(range(block[0], block[0] + length))
    gaps = np.diff([block[0] for block in block_numbers])
    assert (gaps > length).all()
    assert np.ptp(gaps) <= 1
    margins = block_numbers[0][0], count - 1 - block_numbers[-1][-1]
    assert abs(margins[0] - margins[1]) <= 1
    assert [int(number) for number in re.findall(r"\d+", split.words)] == [blocks, length]
    check_text(split.words)


def test_split_every_starts_with_the_first_image():
    split = split_every(image_names(17))
    assert split.test == ("0.jpg", "8.jpg", "16.jpg")
    assert split.blocks == (("0.jpg",), ("8.jpg",), ("16.jpg",))


def test_required_number_of_images_is_reported():
    assert len(split_every(image_names(9)).train) == 7
    with check_error():
        split_every(image_names(8))
    with check_error():
        split_every(image_names(8), 1)


def test_hold_out_settings():
    names = image_names(40)
    assert hold_out(names, "none").train == names
    assert hold_out(names, "none").test == ()
    assert hold_out(names, "every") == split_every(names)
    assert hold_out(names, "blocks") == split_blocks(names)


def test_name_order_is_kept_unless_positions_contradict_it():
    positions, names = circle_positions(60), image_names(60)
    assert capture_order(names, dict(zip(names, positions, strict=True))) == names
    permutation = np.random.default_rng(4).permutation(60)
    order = capture_order(names, dict(zip(names, positions[permutation], strict=True)))
    steps = np.linalg.norm(np.diff([positions[permutation][int(name[:-4])] for name in order], axis=0), axis=1)
    assert sorted(order) == sorted(names)
    assert order[0] == names[0]
    assert np.median(steps) < 1.01 * np.linalg.norm(positions[1] - positions[0])
    assert capture_order(names, dict(zip(names[1:], positions[permutation], strict=False))) == names  # one is unknown


def test_blocks_of_unordered_names_contain_neighbors():
    names = image_names(64)
    positions = circle_positions(64)[np.random.default_rng(1).permutation(64)]
    position_by_name = dict(zip(names, positions, strict=True))
    extents_by_position = [
        np.ptp([position_by_name[n] for n in block], axis=0).max()
        for block in split_blocks(names, 4, 0.25, position_by_name).blocks
    ]
    extents_by_name = [
        np.ptp([position_by_name[n] for n in block], axis=0).max() for block in split_blocks(names, 4, 0.25).blocks
    ]
    assert max(extents_by_position) < 0.5 * min(extents_by_name)


def test_equal_positions_keep_the_name_order():
    names = image_names(40)
    assert capture_order(names, dict.fromkeys(names, np.zeros(3))) == names


def test_too_few_images_are_refused():
    for count, n in ((8, 8), (1, 8), (0, 8), (10, 1)):
        with check_error():
            split_every(image_names(count), n)
    with check_error():
        split_blocks(image_names(31))
    with check_error():
        split_blocks(image_names(40), 0)
