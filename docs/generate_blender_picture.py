"""Draw docs/blender.png: a take imported by the Blender add-on, and its motion on a character. Run by Blender's Python:

.blender/bin/python docs/generate_blender_picture.py MOCAPFIX TAKE FRAME

MOCAPFIX is the path of the program, TAKE a capture file, for example demo.c3d of `mocapfix demo`. `make addon` builds the add-on.
The committed picture is reduced to 40 colours.
"""

import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
from mathutils import Vector  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parent.parent
ADDON = "bl_ext.user_default.mocapfix"
PICTURE = ROOT / "docs" / "blender.png"
SIZE, SAMPLES = (840, 500), 32
COLOURS = {
    "bone": (0.08, 0.2, 0.5, 1), "character": (0.12, 0.12, 0.12, 1), "measured": (0.02, 0.25, 0.06, 1),
    "filled": (0.9, 0.2, 0.01, 1), "floor": (0.3, 0.3, 0.32, 1),
}  # fmt: skip
CHARACTER_OFFSET_M = 1.3


def build_material(name: str):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = COLOURS[name]
    return material


def add_bones(armature, material) -> None:
    """Add an octahedron for each bone, as Blender draws bones."""
    points, faces = [], []
    for bone in armature.pose.bones:
        head, tail = (armature.matrix_world @ each for each in (bone.head, bone.tail))
        axis = tail - head
        side = axis.orthogonal().normalized() * axis.length * 0.1
        other = axis.cross(side).normalized() * axis.length * 0.1
        first, middle = len(points), head + 0.1 * axis
        points += [head, tail, middle + side, middle + other, middle - side, middle - other]
        for k in range(4):
            pair = (first + 2 + k, first + 2 + (k + 1) % 4)
            faces += [(first, *pair), (first + 1, *reversed(pair))]
    mesh = bpy.data.meshes.new("bones")
    mesh.from_pydata(points, [], faces)
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("bones", mesh))


def add_markers(materials) -> None:
    """Add a ball for each marker that is visible: filled ones are larger."""
    for empty in [each for each in bpy.data.objects if "mocapfix_marker" in each and not each.hide_viewport]:
        state = "filled" if empty["filled"] else "measured"
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.018 if empty["filled"] else 0.011, location=empty.matrix_world.translation)
        bpy.context.object.data.materials.append(materials[state])


def add_surroundings(target: Vector, material) -> None:
    bpy.ops.mesh.primitive_plane_add(size=60)
    bpy.context.object.data.materials.append(material)
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.3, 0.2))
    bpy.context.object.data.energy, bpy.context.object.data.angle = 1.8, 0.2
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.55, 0.58, 0.62, 1)
    bpy.ops.object.camera_add(location=target + Vector((1.0, -4.9, 0.6)))
    camera = bpy.context.scene.camera = bpy.context.object
    camera.rotation_euler = (target - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 46


def draw_picture(executable: str, take: str, frame: int) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="rigify")
    archive = next((ROOT / "dist").glob("mocapfix_blender-*.zip"))
    bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
    bpy.context.preferences.addons[ADDON].preferences.executable = executable
    bpy.ops.mocapfix.import_take(filepath=take)
    imported = bpy.context.object
    bpy.ops.object.armature_human_metarig_add()
    character = bpy.context.object
    character.scale = (0.8, 0.8, 0.8)
    character.location.x = CHARACTER_OFFSET_M
    bpy.context.view_layer.update()
    bpy.ops.mocapfix.retarget(filepath=take, feet="lock")
    scene = bpy.context.scene
    scene.frame_set(frame)
    materials = {name: build_material(name) for name in COLOURS}
    add_bones(imported, materials["bone"])
    add_bones(character, materials["character"])
    add_markers(materials)
    hips = imported.matrix_world @ imported.pose.bones["Hips"].head
    add_surroundings(Vector((hips.x + CHARACTER_OFFSET_M / 2, hips.y, 0.85)), materials["floor"])
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", SAMPLES, True
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.image_settings.color_depth, scene.render.image_settings.compression = "8", 100
    scene.render.filepath = str(PICTURE)
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    draw_picture(sys.argv[1], sys.argv[2], int(sys.argv[3]))
