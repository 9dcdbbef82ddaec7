/** Points and line segments whose buffers are written in place, without those that are missing. */

import { THREE } from "./three.js";

class Layer {
  constructor(capacity) {
    this.count = 0;
    this.geometry = new THREE.BufferGeometry();
    this.positions = this.addAttribute("position", capacity);
    this.colors = this.addAttribute("color", capacity);
  }

  addAttribute(name, capacity) {
    const attribute = new THREE.BufferAttribute(new Float32Array(3 * Math.max(capacity, 1)), 3);
    attribute.setUsage(THREE.DynamicDrawUsage);
    this.geometry.setAttribute(name, attribute);
    return attribute;
  }

  write(slot, array, offset, color) {
    const { array: positions } = this.positions, { array: colors } = this.colors, start = 3 * slot;
    positions[start] = array[offset];
    positions[start + 1] = array[offset + 1];
    positions[start + 2] = array[offset + 2];
    colors[start] = color.r;
    colors[start + 1] = color.g;
    colors[start + 2] = color.b;
  }

  begin() {
    this.count = 0;
  }

  finish() {
    this.geometry.setDrawRange(0, this.count);
    this.positions.needsUpdate = this.colors.needsUpdate = true;
    this.object.visible = this.count > 0;
  }

  dispose() {
    this.object.removeFromParent();
    this.geometry.dispose();
    this.object.material.dispose();
  }
}

export class PointLayer extends Layer {
  constructor(capacity, { size, order, texture, leastPixels, isOnTop = false }) {
    super(capacity);
    const material = new THREE.PointsMaterial({
      size, map: texture, alphaTest: 0.5, vertexColors: true, sizeAttenuation: true, depthTest: !isOnTop, depthWrite: !isOnTop,
    });
    material.onBeforeCompile = (shader) => { // points stay visible from far away
      shader.vertexShader = shader.vertexShader.replace(
        "#include <logdepthbuf_vertex>", `gl_PointSize = max(gl_PointSize, ${leastPixels.toFixed(1)});\n#include <logdepthbuf_vertex>`);
    };
    material.customProgramCacheKey = () => `least ${leastPixels}`;
    this.object = new THREE.Points(this.geometry, material);
    this.object.frustumCulled = false;
    this.object.renderOrder = order;
  }

  add(array, offset, color) {
    if (Number.isNaN(array[offset])) return;
    this.write(this.count, array, offset, color);
    this.count += 1;
  }
}

export class SegmentLayer extends Layer {
  constructor(capacity, order) {
    super(2 * capacity);
    this.object = new THREE.LineSegments(this.geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.object.frustumCulled = false;
    this.object.renderOrder = order;
  }

  add(array, from, to, color, toColor = color) {
    if (Number.isNaN(array[from]) || Number.isNaN(array[to])) return;
    this.write(this.count, array, from, color);
    this.write(this.count + 1, array, to, toColor);
    this.count += 2;
  }
}

export function drawDisc(isRing) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const context = canvas.getContext("2d");
  context.fillStyle = context.strokeStyle = "#fff";
  context.lineWidth = 7;
  context.beginPath();
  context.arc(32, 32, isRing ? 27 : 31, 0, 2 * Math.PI);
  if (isRing) context.stroke();
  else context.fill();
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}
