"""Fuzzing of the readers and writers of characters: damaged glTF and VRM files are read and written with a motion, or refused."""

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import Character, CharacterMotion, build_cmu31_character
from mocapfix.characters.character_files import write_character_bvh, write_character_glb
from mocapfix.characters.load_character import load_character, read_character_skeletons
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.errors import ReadError
from mocapfix.io.gltf import BINARY_CHUNK, GLB_CHUNK_HEADER, GLB_HEADER, GLB_MAGIC, GLB_VERSION, JSON_CHUNK, parse_glb
from mocapfix.lab.fuzz_files import ANY_MUTATIONS, TEXT_MUTATIONS
from mocapfix.model.skeleton import load_cmu31_skeleton

MAX_CHARACTER_MUTATIONS = 4  # of one file
CONTAINER_SHARE = 0.2  # of the damaged GLB files of which the bytes are changed, with their lengths; of the others it is the JSON
SEED_VRM_BONES: Mapping[str, str] = {
    "hips": "Hips", "spine": "LowerBack", "chest": "Spine", "head": "Head",
    **{f"{side.lower()}{bone}": f"{side}{joint}" for side in ("Left", "Right") for bone, joint in (
        ("UpperArm", "Arm"), ("LowerArm", "ForeArm"), ("Hand", "Hand"),
        ("UpperLeg", "UpLeg"), ("LowerLeg", "Leg"), ("Foot", "Foot"),
    )},
}  # fmt: skip
"""humanoid bones and joints of the solved skeleton"""
STRANGE_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3, 10**6, 2**40, 10**400, -0.5, 1e-300, 1e300, "", "x", [], {}, [0], [0, 0, 0], [[]], {"node": 1},
    [None], [1, 0, 0, 0], [1e9, 0, 0], [0] * 16, "data:,", "data:;base64,AAAA", "../x.bin", "http://x/y", "\ud800", float("inf"),
)  # fmt: skip
"""values that a property of the document gets in place of its own"""


@dataclass(frozen=True)
class CharacterCase:
    """A damaged file of a character."""

    name: str
    data: bytes

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.data)

    def save(self, folder: Path) -> None:
        """Write the file."""
        (folder / self.name).write_bytes(self.data)

    def run(self, folder: Path) -> str:
        """Read the character, retarget a motion onto it, and write that."""
        self.save(folder)
        character = load_character(folder / self.name)
        motion = retarget_motion(*build_seed_motion(), character)
        assert np.isfinite(motion.local_rotations).all()
        assert np.isfinite(motion.pelvis_position).all()
        write_character_glb(folder / "out.glb", character, motion, "take")
        write_character_bvh(folder / "out.bvh", character, motion)
        try:
            read_character_skeletons(folder / "out.glb")[0]
        except ReadError as error:
            raise AssertionError(f"The written file cannot be read: {error}") from error
        return "written"


@cache
def build_seed_motion() -> tuple[Character, CharacterMotion]:
    """Return the average figure and a brief motion: it turns about, its arms and legs swing."""
    character = build_cmu31_character(load_cmu31_skeleton())
    rng, frames = np.random.default_rng(0), 4
    turns = Rotation.from_rotvec(rng.normal(scale=0.5, size=(frames * len(character.skeleton.names), 3))).as_matrix()
    rotations = turns.reshape(frames, -1, 3, 3)
    return character, CharacterMotion(np.tile([0.0, 0.95, 0.0], (frames, 1)), rotations, 30.0)


@cache
def list_character_seeds() -> tuple[CharacterCase, ...]:
    """Return a valid file of each format."""
    character = build_cmu31_character(load_cmu31_skeleton())
    data = _write_glb(character)
    document, binary = parse_glb(Path("seed.glb"), data).document, parse_glb(Path("seed.glb"), data).binary
    nodes = {node["name"]: index for index, node in enumerate(document["nodes"])}
    human = {bone: nodes[joint] for bone, joint in SEED_VRM_BONES.items()}
    humanoid = {"humanBones": {bone: {"node": node} for bone, node in human.items()}}
    humanoid_0 = {"humanBones": [{"bone": bone, "node": node} for bone, node in human.items()]}
    vrm_1 = document | {"extensions": {"VRMC_vrm": {"humanoid": humanoid}}}
    vrm_0 = document | {"extensions": {"VRM": {"humanoid": humanoid_0}}}
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    embedded = vrm_1 | {"buffers": [document["buffers"][0] | {"uri": uri}]}
    return (
        CharacterCase("figure.glb", data),
        CharacterCase("one.vrm", _join_chunks(_encode(vrm_1), binary)),
        CharacterCase("zero.vrm", _join_chunks(_encode(vrm_0), binary)),
        CharacterCase("figure.gltf", _encode(embedded)),
    )


def _write_glb(character: Character) -> bytes:
    pelvis = character.mapping.bones["pelvis"][0]
    motion = CharacterMotion(character.skeleton.offsets[pelvis][None], character.skeleton.rest_rotations[None], 30.0)
    with TemporaryDirectory() as folder:
        write_character_glb(Path(folder) / "seed.glb", character, motion, "take")
        return (Path(folder) / "seed.glb").read_bytes()


def _encode(document: dict[str, Any]) -> bytes:
    return json.dumps(document).encode()


def _join_chunks(text: bytes, binary: bytes) -> bytes:
    """Return a GLB with any text as its JSON."""
    text += b" " * (-len(text) % 4)
    chunks = GLB_CHUNK_HEADER.pack(len(text), JSON_CHUNK) + text + GLB_CHUNK_HEADER.pack(len(binary), BINARY_CHUNK) + binary
    return GLB_HEADER.pack(GLB_MAGIC, GLB_VERSION, GLB_HEADER.size + len(chunks)) + chunks


def build_character_case(seed: int) -> CharacterCase:
    """Return the case of a seed: one of the valid files with one to four mutations, of its bytes or of its JSON."""
    rng = np.random.default_rng(seed)
    seeds = list_character_seeds()
    case = seeds[int(rng.integers(len(seeds)))]
    count = int(rng.integers(1, MAX_CHARACTER_MUTATIONS + 1))
    if case.name.endswith(".gltf"):
        return replace(case, data=_mutate(case.data, count, rng, TEXT_MUTATIONS))
    if rng.random() < CONTAINER_SHARE:
        return replace(case, data=_mutate(case.data, count, rng, ANY_MUTATIONS))
    length, _ = GLB_CHUNK_HEADER.unpack_from(case.data, GLB_HEADER.size)
    start = GLB_HEADER.size + GLB_CHUNK_HEADER.size
    text, binary = case.data[start : start + length], case.data[start + length + GLB_CHUNK_HEADER.size :]
    mutate = _change_value if rng.random() < 0.7 else lambda data, rng: _mutate(data, 1, rng, TEXT_MUTATIONS)
    for _ in range(count):
        text = mutate(text, rng)
    return replace(case, data=_join_chunks(text, binary))


def _mutate(
    data: bytes, count: int, rng: np.random.Generator, mutations: tuple[Callable[[bytes, np.random.Generator], bytes], ...]
) -> bytes:
    for _ in range(count):
        data = mutations[int(rng.integers(len(mutations)))](data, rng)
    return data


def _change_value(text: bytes, rng: np.random.Generator) -> bytes:
    """Replace, remove, repeat or exchange a value of the document, at any depth."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return text
    container: Any = document
    while True:
        keys = list(container) if isinstance(container, dict) else list(range(len(container)))
        if not keys:
            return text
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(container[key], dict | list) or not container[key] or rng.random() < 0.25:
            break
        container = container[key]
    match int(rng.integers(4)):
        case 0:
            del container[key]
        case 1 if isinstance(container, list):
            container.insert(int(rng.integers(len(container) + 1)), container[key])
        case 2:
            other = keys[int(rng.integers(len(keys)))]
            container[key], container[other] = container[other], container[key]
        case _:
            container[key] = STRANGE_VALUES[int(rng.integers(len(STRANGE_VALUES)))]
    return json.dumps(document).encode("utf-8", "surrogatepass")
