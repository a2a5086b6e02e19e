"""Training: resumed runs, seeds, masks, empty fields, and the same bits for any threads and instruction set."""

import sys

import numpy as np
import pytest
from field_training import arrays_of, new_training
from kernel_scripts import baseline_digest, check_same_bits, run_with_rising_memory
from optional import import_or_skip
from wording import check_error

torch = import_or_skip("torch")

from pcbench.errors import ReconstructionError  # noqa: E402
from reconstructors.field.train import FieldTraining, Pixels  # noqa: E402
from reconstructors.splat.resume import run_with_checkpoints, save_checkpoint  # noqa: E402


@pytest.mark.parametrize("stop", [7, 12, 13])
def test_a_resumed_training_gives_the_same_bits(tmp_path, stop):
    """Also right before and after voxels are halved, which is at step 12."""
    uninterrupted = new_training()
    uninterrupted.run(40)
    first = new_training()
    first.run(stop)
    save_checkpoint(first, tmp_path / "checkpoint.npz", "key")
    second = new_training()
    assert not second.load(tmp_path / "checkpoint.npz", "another key") and second.step == 0
    field = run_with_checkpoints(second, tmp_path / "checkpoint.npz", "key")
    assert arrays_of(field) == arrays_of(uninterrupted.model)
    assert not (tmp_path / "checkpoint.npz").exists()


def test_a_damaged_checkpoint_is_not_resumed(tmp_path):
    checkpoint = tmp_path / "checkpoint.npz"
    first = new_training()
    first.run(7)
    save_checkpoint(first, checkpoint, "key")
    content = bytearray(checkpoint.read_bytes())
    content[len(content) // 2] ^= 1
    checkpoint.write_bytes(content)
    second = new_training()
    second.load = lambda *_: pytest.fail("the checkpoint was used")
    run_with_checkpoints(second, checkpoint, "key")
    assert second.step == 40 and list(tmp_path.iterdir()) == []


def test_the_field_is_determined_by_the_seed():
    runs = [new_training(seed=seed) for seed in (0, 0, 1)]
    for run in runs:
        run.run(20)
    first, second, other = (arrays_of(run.model) for run in runs)
    assert first == second != other


def test_training_improves_the_photographs():
    training = new_training(steps=200)
    training.run(10)
    first = np.mean(training._errors)
    training.run(200)
    assert np.mean(training._errors[-10:]) < 0.1 * first


def test_masked_pixels_are_not_drawn():
    photographs = [pyramid[0] for pyramid in new_training()._photographs[:3]]
    marked = []
    for number, photograph in enumerate(photographs):
        valid = torch.zeros(photograph.color.shape[:2], dtype=torch.bool)
        valid[3 * number : 3 * number + 5, 4:9] = True
        valid = valid if number != 1 else None
        color = torch.full_like(photograph.color, 10 * number)
        if valid is not None:
            color[valid] = 200 + number
        marked.append(photograph._replace(color=color, valid=valid))
    rays, colors = Pixels(marked).draw(np.random.default_rng(0), 2000)
    drawn = set(np.unique((255 * colors).round()))
    assert drawn == {200, 10, 202}
    position = marked[0].view.position
    assert ((rays.origins == position).all(axis=1) == ((255 * colors[:, 0]).round() == 200)).all()
    assert np.linalg.norm(rays.directions, axis=1) == pytest.approx(1)


def test_masks_of_thin_lines_keep_the_larger_photographs():
    training = new_training(steps=4, rays=64)
    full = training._photographs[0][0]
    small = full._replace(color=full.color[::2, ::2])
    line = torch.zeros(full.color.shape[:2], dtype=torch.bool)
    line[:, 7] = True
    pyramid = [full._replace(valid=line), small._replace(valid=torch.zeros(small.color.shape[:2], dtype=torch.bool))]
    trained = FieldTraining(training.model, [pyramid], training.schedule)
    trained.run(1)
    assert trained.step == 1 and trained._pixels._valid.tolist() == torch.nonzero(line.reshape(-1))[:, 0].tolist()


def test_an_empty_field_is_an_error():
    training = new_training()
    training.model.values[:, 0] = -1
    with check_error(ReconstructionError):
        training.run(5)


def test_a_diverged_training_is_an_error():
    training = new_training()
    training.model.values[:, 1:] = np.nan
    with check_error(ReconstructionError):
        training.run(5)


DIGEST_SCRIPT = """
import json, sys
from field_training import arrays_of, new_training, new_view
from reconstructors.field.native import _field
training = new_training()
training.run(30)
output = training.model.render_geometry(new_view())
images = [part.numpy().tobytes().hex() for part in output]
import hashlib
digest = hashlib.sha256(repr((arrays_of(training.model), images, training._errors)).encode()).hexdigest()
print(json.dumps([_field.isa(), digest]))
"""


@pytest.fixture(scope="module")
def digest():
    return baseline_digest(DIGEST_SCRIPT)


@pytest.mark.long
@pytest.mark.parametrize("isa, threads", [("avx2", "2"), ("avx512", "3")])
def test_threads_and_instruction_sets_give_the_same_bits(digest, isa, threads):
    """As one thread of the baseline."""
    check_same_bits(DIGEST_SCRIPT, digest, isa, threads)


MEMORY_SCRIPT = """
import sys
from field_training import gradients_of, new_training
from kernel_scripts import compute_with_rising_memory
training = new_training(rays=int(sys.argv[1]))
gradients_of(new_training())()  # starts all threads
compute = gradients_of(training)
expected = compute()
failures, result = compute_with_rising_memory(compute)
print(failures, result == expected)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_running_out_of_memory_raises_a_memory_error():
    """Each large allocation fails once; the final result is that without a limit."""
    run_with_rising_memory(MEMORY_SCRIPT, 20_000, threads=2)
