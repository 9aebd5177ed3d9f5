// A skinned body from the GLB in this page: every influence and every morph target, evaluated here, since
// graphics cards' usual skinning takes four influences. The names of the glTF 2.0 specification are kept.
"use strict";

const ARRAYS = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 };

class Glb {
  constructor(buffer) {
    const view = new DataView(buffer);
    const size = view.getUint32(12, true);
    this.json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, size)));
    this.data = buffer.slice(28 + size);
  }
  stored(place, componentType, width, count) {
    const offset = (this.json.bufferViews[place.bufferView].byteOffset || 0) + (place.byteOffset || 0);
    return new ARRAYS[componentType](this.data, offset, count * width);
  }
  accessor(index) {
    const { type, componentType, count } = this.json.accessors[index];
    return this.stored(this.json.accessors[index], componentType, WIDTHS[type], count);
  }
  sparse(index) {
    const { sparse } = this.json.accessors[index];
    return {
      ids: this.stored(sparse.indices, sparse.indices.componentType, 1, sparse.count),
      values: this.stored(sparse.values, 5126, 3, sparse.count),
    };
  }
}

class Body {
  constructor(glb) {
    const { json } = glb, primitive = json.meshes[0].primitives[0], { attributes } = primitive;
    this.rest = glb.accessor(attributes.POSITION);
    this.restNormals = glb.accessor(attributes.NORMAL);
    this.indices = glb.accessor(primitive.indices);
    this.count = this.rest.length / 3;
    this.canonical = json.asset.extras.canonical_vertex_count;
    this.targets = (primitive.targets || []).map((target) => glb.sparse(target.POSITION));
    this.joints = json.skins[0].joints;
    this.inverseBind = glb.accessor(json.skins[0].inverseBindMatrices);
    this.nodes = json.nodes.map((node, index) => ({ ...node, index, parent: -1 }));
    for (const node of this.nodes) for (const child of node.children || []) this.nodes[child].parent = node.index;
    this.readSkin(glb, attributes);
    this.readAnimation(glb, json.animations[0]);
    this.worlds = this.nodes.map(() => new Three.Matrix4());
    this.positions = new Float32Array(this.rest.length);
    this.normals = new Float32Array(this.rest.length);
    this.moved = new Float32Array(this.rest.length);
    this.matrices = new Float32Array(12 * this.joints.length);
  }
  readSkin(glb, attributes) {
    const sets = [];
    for (let set = 0; attributes[`JOINTS_${set}`] !== undefined; set++)
      sets.push([glb.accessor(attributes[`JOINTS_${set}`]), glb.accessor(attributes[`WEIGHTS_${set}`])]);
    this.begin = new Uint32Array(this.count + 1);
    const joints = [], weights = [];
    for (let v = 0; v < this.count; v++) {
      for (const [ids, values] of sets)
        for (let k = 4 * v; k < 4 * v + 4; k++)
          if (values[k] > 0) { joints.push(ids[k]); weights.push(values[k]); }
      this.begin[v + 1] = joints.length;
    }
    this.influences = Uint16Array.from(joints);
    this.weights = Float32Array.from(weights);
  }
  readAnimation(glb, animation) {
    this.tracks = animation.channels.map(({ sampler, target }) => ({
      ...target, values: glb.accessor(animation.samplers[sampler].output),
    }));
    this.times = glb.accessor(animation.samplers[0].input);
    this.frameCount = this.times.length;
    this.fps = this.frameCount > 1 ? (this.frameCount - 1) / this.times[this.frameCount - 1] : 30;
  }
  // Poses the body at a place between frames: everything is interpolated linearly, as glTF says.
  pose(place) {
    const first = Math.min(Math.floor(place), this.frameCount - 1), second = Math.min(first + 1, this.frameCount - 1);
    const share = place - first;
    const parts = this.nodes.map((node) => ({ translation: node.translation, rotation: node.rotation }));
    let shape = [];
    for (const { node, path, values } of this.tracks) {
      const width = values.length / this.frameCount, found = new Float64Array(width);
      let sign = 1;
      if (path === "rotation") {
        let dot = 0;
        for (let k = 0; k < 4; k++) dot += values[first * 4 + k] * values[second * 4 + k];
        sign = dot < 0 ? -1 : 1;
      }
      for (let k = 0; k < width; k++)
        found[k] = (1 - share) * values[first * width + k] + share * sign * values[second * width + k];
      if (path === "weights") shape = found; else parts[node][path] = found;
    }
    this.walk(parts);
    this.morph(shape);
    this.skin();
  }
  walk(parts) {
    const one = new Three.Vector3(1, 1, 1), place = new Three.Vector3(), turn = new Three.Quaternion();
    const local = new Three.Matrix4(), skinning = new Three.Matrix4(), bind = new Three.Matrix4();
    for (const { index, parent } of this.nodes) {  // parents come first
      const { translation = [0, 0, 0], rotation = [0, 0, 0, 1] } = parts[index];
      local.compose(place.fromArray(translation), turn.fromArray(rotation).normalize(), one);
      if (parent < 0) this.worlds[index].copy(local);
      else this.worlds[index].multiplyMatrices(this.worlds[parent], local);
    }
    this.joints.forEach((node, joint) => {
      const { elements: e } = skinning.multiplyMatrices(this.worlds[node], bind.fromArray(this.inverseBind, 16 * joint));
      for (let row = 0; row < 3; row++)
        for (let column = 0; column < 4; column++) this.matrices[12 * joint + 4 * row + column] = e[4 * column + row];
    });
  }
  morph(shape) {
    this.moved.set(this.rest);
    this.targets.forEach(({ ids, values }, target) => {
      const weight = shape[target];
      if (!weight) return;
      for (let k = 0; k < ids.length; k++)
        for (let axis = 0; axis < 3; axis++) this.moved[3 * ids[k] + axis] += weight * values[3 * k + axis];
    });
  }
  skin() {
    const { begin, influences, weights, matrices, moved, restNormals, positions, normals } = this;
    const m = new Float64Array(12);
    for (let v = 0; v < this.count; v++) {
      m.fill(0);
      for (let k = begin[v]; k < begin[v + 1]; k++) {
        const weight = weights[k], from = 12 * influences[k];
        for (let e = 0; e < 12; e++) m[e] += weight * matrices[from + e];
      }
      const x = moved[3 * v], y = moved[3 * v + 1], z = moved[3 * v + 2];
      const a = restNormals[3 * v], b = restNormals[3 * v + 1], c = restNormals[3 * v + 2];
      for (let row = 0; row < 3; row++) {
        positions[3 * v + row] = m[4 * row] * x + m[4 * row + 1] * y + m[4 * row + 2] * z + m[4 * row + 3];
        normals[3 * v + row] = m[4 * row] * a + m[4 * row + 1] * b + m[4 * row + 2] * c;
      }
    }
  }
}

async function unpacked(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

class View {
  constructor(body, glb) {
    this.body = body;
    const canvas = document.getElementById("view");
    this.renderer = new Three.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = Three.PCFShadowMap;
    this.scene = new Three.Scene();
    this.scene.background = new Three.Color(0xf6f6f4);
    this.camera = new Three.PerspectiveCamera(32, 1, 0.05, 500);
    this.controls = new Three.OrbitControls(this.camera, canvas);
    this.addBody(glb);
    this.addEyes(glb);
    this.addSkeleton();
    this.addLights();
    this.place();
    addEventListener("resize", () => this.resize());
    this.resize();
  }
  material(glb, index) {
    const surface = glb.json.materials[index].pbrMetallicRoughness;
    const material = new Three.MeshStandardMaterial({ roughness: surface.roughnessFactor, metalness: 0 });
    material.color.setRGB(...surface.baseColorFactor.slice(0, 3));
    return material;
  }
  // Meshes without a skin hang on their nodes.
  addEyes(glb) {
    this.eyes = [];
    for (const { index, mesh } of this.body.nodes.filter((node) => node.mesh > 0))
      for (const { attributes, indices, material } of glb.json.meshes[mesh].primitives) {
        const geometry = new Three.BufferGeometry();
        geometry.setIndex(new Three.BufferAttribute(glb.accessor(indices), 1));
        geometry.setAttribute("position", new Three.BufferAttribute(glb.accessor(attributes.POSITION), 3));
        geometry.setAttribute("normal", new Three.BufferAttribute(glb.accessor(attributes.NORMAL), 3));
        const shown = new Three.Mesh(geometry, this.material(glb, material));
        shown.matrixAutoUpdate = shown.frustumCulled = false;
        this.eyes.push({ shown, index });
        this.scene.add(shown);
      }
  }
  addBody(glb) {
    const { body } = this, geometry = new Three.BufferGeometry();
    geometry.setIndex(new Three.BufferAttribute(body.indices, 1));
    geometry.setAttribute("position", new Three.BufferAttribute(body.positions, 3));
    geometry.setAttribute("normal", new Three.BufferAttribute(body.normals, 3));
    this.mesh = new Three.Mesh(geometry, this.material(glb, 0));
    this.mesh.frustumCulled = false;
    this.mesh.castShadow = this.mesh.receiveShadow = true;
    this.scene.add(this.mesh);
  }
  addSkeleton() {
    this.bones = this.body.nodes.filter((node) => node.mesh === undefined && node.parent > 0 && this.body.nodes[node.parent].parent > 0);
    const geometry = new Three.BufferGeometry();
    geometry.setAttribute("position", new Three.BufferAttribute(new Float32Array(6 * this.bones.length), 3));
    this.skeleton = new Three.LineSegments(geometry, new Three.LineBasicMaterial({
      color: 0x1d3d8f, depthTest: false, transparent: true,  // drawn after the body
    }));
    this.skeleton.frustumCulled = this.skeleton.visible = false;
    this.skeleton.renderOrder = 1;
    this.scene.add(this.skeleton);
  }
  addLights() {
    this.scene.add(new Three.HemisphereLight(0xffffff, 0xb9b4ac, 1.5));
    this.sun = new Three.DirectionalLight(0xfff4e6, 2.1);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(2048, 2048);
    Object.assign(this.sun.shadow.camera, { left: -1.6, right: 1.6, top: 2.4, bottom: -1.6, near: 0.1, far: 14 });
    this.sun.shadow.bias = -0.0004;
    this.sun.shadow.normalBias = 0.01;
    this.sun.shadow.radius = 6;
    this.scene.add(this.sun, this.sun.target);
    this.floor = new Three.Mesh(new Three.PlaneGeometry(60, 60), new Three.ShadowMaterial({ opacity: 0.22 }));
    this.floor.rotation.x = -Math.PI / 2;
    this.floor.receiveShadow = true;
    this.scene.add(this.floor);
  }
  place() {
    const { body } = this;
    let low = Infinity, high = -Infinity;
    for (let sample = 0; sample < 12; sample++) {
      body.pose(Math.round((sample * (body.frameCount - 1)) / 11));
      for (let k = 1; k < body.positions.length; k += 3) {
        low = Math.min(low, body.positions[k]);
        high = Math.max(high, body.positions[k]);
      }
    }
    this.floor.position.y = low - 0.001;
    body.pose(0);
    this.hips = this.place_of_hips();
    this.controls.target.set(this.hips.x, (low + high) / 2, this.hips.z);
    const distance = 1.35 * (high - low) / 2 / Math.tan((16 * Math.PI) / 180);
    this.camera.position.copy(this.controls.target).add(new Three.Vector3(0.42, 0.2, 0.88).multiplyScalar(distance));
  }
  place_of_hips() {
    const hips = this.body.nodes.find((node) => node.name === "Hips") || this.body.nodes[this.body.joints[0]];
    return new Three.Vector3().setFromMatrixPosition(this.body.worlds[hips.index]);
  }
  resize() {
    this.renderer.setSize(innerWidth, innerHeight, false);
    this.camera.aspect = innerWidth / innerHeight;
    this.camera.updateProjectionMatrix();
  }
  show(place, follow) {
    this.body.pose(place);
    for (const name of ["position", "normal"]) this.mesh.geometry.attributes[name].needsUpdate = true;
    const ends = this.skeleton.geometry.attributes.position, point = new Three.Vector3();
    this.bones.forEach((bone, k) => {
      ends.setXYZ(2 * k, ...point.setFromMatrixPosition(this.body.worlds[bone.parent]));
      ends.setXYZ(2 * k + 1, ...point.setFromMatrixPosition(this.body.worlds[bone.index]));
    });
    ends.needsUpdate = true;
    for (const { shown, index } of this.eyes) {
      shown.matrix.copy(this.body.worlds[index]);
      shown.matrixWorldNeedsUpdate = true;
    }
    const hips = this.place_of_hips(), step = hips.clone().sub(this.hips).setY(0);
    this.hips = hips;
    if (follow) for (const one of [this.camera.position, this.controls.target]) one.add(step);
    this.sun.target.position.copy(hips);
    this.sun.position.copy(hips).add(new Three.Vector3(1.6, 4.2, 2.6));
  }
  render() {
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

class Player {
  constructor(view) {
    this.view = view;
    this.place = 0;
    this.playing = false;
    this.last = null;
    const { frameCount, fps } = view.body;
    this.byId = Object.fromEntries(
      ["play", "time", "clock", "speed", "loop", "follow", "skeleton"].map((id) => [id, document.getElementById(id)]));
    this.byId.time.max = frameCount - 1;
    this.byId.time.addEventListener("input", () => this.go(Number(this.byId.time.value)));
    this.byId.play.addEventListener("click", () => this.toggle());
    this.byId.skeleton.addEventListener("change", () => {
      view.skeleton.visible = this.byId.skeleton.checked;
      view.mesh.material.transparent = this.byId.skeleton.checked;
      view.mesh.material.opacity = this.byId.skeleton.checked ? 0.55 : 1;
      view.mesh.material.needsUpdate = true;
    });
    addEventListener("keydown", (event) => {
      if (event.code !== "Space" || event.target.tagName === "BUTTON") return;
      event.preventDefault();
      this.toggle();
    });
    this.tell = () => `${(this.place / fps).toFixed(2)} / ${((frameCount - 1) / fps).toFixed(2)} s`;
    this.go(0);
    if (frameCount > 1) this.toggle();
    requestAnimationFrame((now) => this.step(now));
  }
  toggle() {
    const last = this.view.body.frameCount - 1;
    if (!this.playing && this.place >= last) this.place = 0;
    this.playing = !this.playing && last > 0;
    this.last = null;
    this.byId.play.textContent = this.playing ? "Pause" : "Play";
  }
  go(place) {
    this.place = place;
    this.view.show(place, this.byId.follow.checked);
    this.byId.time.value = place;
    this.byId.clock.textContent = this.tell();
  }
  step(now) {
    if (this.playing && this.last !== null) {
      const { frameCount, fps } = this.view.body, end = frameCount - 1;
      let place = this.place + ((now - this.last) / 1000) * fps * Number(this.byId.speed.value);
      if (place > end) {
        if (this.byId.loop.checked) place %= end;
        else { place = end; this.toggle(); }
      }
      this.go(place);
    }
    this.last = this.playing ? now : null;
    this.view.render();
    requestAnimationFrame((next) => this.step(next));
  }
}

function tellAbout(json) {
  const facts = Object.entries(json.asset.extras).filter(([, value]) => value !== "");
  document.querySelector("#about summary").textContent = json.nodes[0].name;
  const list = document.querySelector("#about dl");
  for (const [key, value] of facts) {
    const [term, text] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = key.replaceAll("_", " ");
    text.textContent = String(value);
    list.append(term, text);
  }
}

// `soma.ready` tells when the body stands; `soma.vertex(i)` gives a canonical vertex [m] as it is shown.
const soma = { ready: null };
soma.ready = (async () => {
  const glb = new Glb(await unpacked(document.getElementById("body").textContent));
  tellAbout(glb.json);
  const body = new Body(glb), player = new Player(new View(body, glb));
  Object.assign(soma, {
    frameCount: body.frameCount, vertexCount: body.canonical, player,
    setFrame: (frame) => { if (player.playing) player.toggle(); player.go(frame); player.view.render(); },
    vertex: (index) => Array.from(body.positions.subarray(3 * index, 3 * index + 3)),
    node: (name) => body.worlds[body.nodes.findIndex((node) => node.name === name)].toArray(),
    vertices: () => Array.from(body.positions.subarray(0, 3 * body.canonical)),
  });
  return true;
})().catch((error) => {
  const place = document.getElementById("failed");
  place.textContent = `This body cannot be shown: ${error.message}`;
  place.hidden = false;
  throw error;
});
