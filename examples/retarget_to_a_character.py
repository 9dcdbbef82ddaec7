"""Put the solved motion on a character, with standing feet locked, and print where its feet stand."""

from pathlib import Path

import mocapfix
from mocapfix.characters.character import build_cmu31_character, compute_character_poses, convert_motion
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.options import OutputOptions
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("retarget.c3d")
write_synthetic_take(path, compose_take(seed=11, seconds=2.0))

result = mocapfix.clean(path, prior="none", feet="lock")
character = load_character("mixamo")  # or the path of a .glb, .vrm, .bvh or .yaml file
if result.subject and result.motion and result.contacts:
    source = build_cmu31_character(result.subject.skeleton)
    performed = convert_motion(result.motion, result.input_take.rate)
    motion = retarget_motion(source, performed, character, contacts=result.contacts)
    position, _ = compute_character_poses(character, motion)  # (frames, bones, 3) metres
    toe = position[:, character.skeleton.find_joint("mixamorig:LeftToeBase")]
    for first, last in result.contacts.list_intervals("LeftToeBase"):
        x, _, z = toe[first : last + 1].mean(0)
        print(f"frames {first} to {last}: the left foot stands at x = {x:.3f} m, z = {z:.3f} m")

options = OutputOptions(characters=("mixamo",))
for output in result.write("retarget.mocapfix", overwrite=True, options=options).values():
    print(output)
