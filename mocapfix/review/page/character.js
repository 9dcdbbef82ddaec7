// A character that the body moves, beside it: the written GLB with its first animation, which is that of the take.

import { GLTFLoader, THREE } from "./three.js";

const BESIDE_M = new THREE.Vector3(1.0, 0, -0.6); // to the right in the first view of a take
const MAX_FRAME_S = 0.05; // after the last key the pose stays for a frame
const HEIGHT_M = 1.75; // with which each character is shown

export class CharacterView {
  // Loads a file; throws an error that says why it cannot be shown.
  static async load(url) {
    const file = await new GLTFLoader().loadAsync(url), clip = file.animations[0];
    if (!clip) throw new Error("it has no animation");
    return new CharacterView(file.scene, clip);
  }

  constructor(model, clip) {
    this.clip = clip;
    this.group = new THREE.Group();
    this.group.add(model);
    this.mixer = new THREE.AnimationMixer(model);
    this.mixer.clipAction(clip).play();
    const hips = clip.tracks.filter((each) => each.name.endsWith(".position")).at(-1);
    this.hips = hips ? THREE.PropertyBinding.findNode(model, THREE.PropertyBinding.parseTrackName(hips.name).nodeName) : model;
    model.traverse((each) => { each.frustumCulled = false; });
    this.place = new THREE.Vector3();
    this.group.scale.setScalar(HEIGHT_M / Math.max(1e-6, new THREE.Box3().setFromObject(model).getSize(this.place).y));
  }

  // Shows the pose at a time, beside the place of the body's root, [x, y, z]. It stands on the floor of the motion files.
  show(time, root, floor) {
    this.group.visible = root.length > 0 && !Number.isNaN(root[0]) && time >= 0 && time < this.clip.duration + MAX_FRAME_S;
    if (!this.group.visible) return;
    this.mixer.setTime(Math.min(time, this.clip.duration * (1 - 1e-6)));
    this.group.position.set(0, floor, 0);
    this.group.updateMatrixWorld(true);
    this.hips.getWorldPosition(this.place);
    this.group.position.set(root[0] + BESIDE_M.x - this.place.x, floor, root[2] + BESIDE_M.z - this.place.z);
  }
}
