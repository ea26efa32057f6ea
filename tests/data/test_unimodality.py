import numpy as np
import pytest

from torch_pbd.data import Demonstrations, check_unimodal, load_demonstrations, make_tunnel_demonstrations
from torch_pbd.exceptions import UnimodalityWarning


@pytest.mark.parametrize("n_demos", [6, 12, 30])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_paths_are_found_and_one_is_not(n_demos, seed):
    one = make_tunnel_demonstrations(n_demos, rate=10.0, random_state=seed)
    assert check_unimodal(one)
    two = make_tunnel_demonstrations(n_demos, rate=10.0, random_state=seed, variant="two_path")
    with pytest.warns(UnimodalityWarning, match="two ways"):
        assert not check_unimodal(two)


def test_two_paths_without_noise_are_found():
    """All they differ by is one direction: every other singular value is zero."""
    time = np.linspace(0.0, 1.0, 50)
    ways = [np.column_stack([side * np.sin(np.pi * time), time]) for side in (1.0, -1.0)]
    with pytest.warns(UnimodalityWarning, match="two ways"):
        assert not check_unimodal(Demonstrations(time, [ways[k % 2] for k in range(8)]))


def test_recordings_that_end_in_two_places_are_found(recordings):
    with pytest.warns(UnimodalityWarning, match="two ways"):
        check_unimodal(load_demonstrations(recordings / "mouse_choice_1.npz"))


def test_the_odd_letter_is_named(recordings):
    letters = load_demonstrations(recordings / "letter_A.npz")
    with pytest.warns(UnimodalityWarning, match=r"Demonstration \d is far from the other 9") as caught:
        check_unimodal(letters)
    odd = int(str(caught[0].message).split()[1])
    positions = letters.to_array()
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=(1, 2))
    assert odd == distance.argmax()


@pytest.mark.parametrize("name", ["letter_G", "pen_a", "kuka_cube_pick", "snooker_skilled", "adroit_door_palm"])
def test_other_recordings_pass(name, recordings):
    assert check_unimodal(load_demonstrations(recordings / f"{name}.npz"))
