// The film under the touch in three dimensions, in plain WebGL: a sheet whose nodes gather round the probe.

import { Deflection } from "./deflection.js";
import { fit, lineStyle, onTheme, rgb, theme } from "./theme.js";

const VERTEX = `
attribute vec3 place; attribute vec3 normal; attribute float depth;
uniform mat4 camera; varying vec3 n; varying float d;
void main() { n = normal; d = depth; gl_Position = camera * vec4(place, 1.0); }`;
const FRAGMENT = `
precision mediump float;
uniform vec3 flat_colour, deep_colour; uniform vec3 light; uniform float lit; varying vec3 n; varying float d;
void main() {
  vec3 colour = mix(flat_colour, deep_colour, clamp(d, 0.0, 1.0));
  float shade = mix(1.0, 0.62 + 0.46 * abs(dot(normalize(n), light)), lit);
  float contour = lit * smoothstep(0.44, 0.5, abs(fract(d * 8.0) - 0.5)) * step(0.02, d);
  gl_FragColor = vec4(colour * shade * (1.0 - 0.10 * contour), 1.0);
}`;
const STRETCH = 4, AROUND = 72, FLAT_AROUND = 32, FLAT_RINGS = [0, 0.25, 0.5, 0.75, 1];

export class Relief {
  constructor(canvas, caption, film) {
    Object.assign(this, { canvas, caption, film, yaw: -0.55, pitch: 0.62, isStale: true });
    this.radius = film.film?.radius_mm ?? 45;
    const probe = /^circle:([\d.]+)/.exec(film.probes[0] ?? ""), isDescribed = film.film?.radius_mm && film.film.thickness_um && film.film.young_GPa;
    this.deflection = isDescribed ? new Deflection(film.film, Number(probe?.[1] ?? 1), film.force_range_N[1]) : null;
    [this.gl, this.finest] = isDrawnByProcessor() ? [canvas.getContext("webgl", { antialias: false }), 1] : [canvas.getContext("webgl", { antialias: true }), 1.5];
    if (!this.gl) { canvas.hidden = true; caption.textContent = "This browser has no WebGL: no 3D view."; return; }
    this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.prepare(); this.isStale = true; });
    onTheme(() => { this.isStale = true; });
    this.listen();
    this.sayCaption(null);
  }

  prepare() {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    ["place", "normal", "depth"].forEach((name, k) => gl.bindAttribLocation(program, k, name));
    gl.linkProgram(program); gl.useProgram(program);
    const uniforms = ["camera", "flat_colour", "deep_colour", "light", "lit"];
    this.uniform = Object.fromEntries(uniforms.map((name) => [name, gl.getUniformLocation(program, name)]));
    for (const k of [0, 1, 2]) gl.enableVertexAttribArray(k);
    gl.enable(gl.DEPTH_TEST);
    this.layOutSheet();
    this.points = gl.createBuffer();
  }

  layOutSheet() {
    const { gl } = this, d = this.deflection;
    [this.rings, this.around] = d ? [d.rings.length, AROUND] : [FLAT_RINGS.length, FLAT_AROUND];
    this.nodes = new Float32Array(this.rings * this.around * 7);
    const triangles = [];
    for (let i = 0; i + 1 < this.rings; i++) for (let j = 0; j < this.around; j++) {
      const k = (j + 1) % this.around, [a, b, c, e] = [i * this.around + j, i * this.around + k, (i + 1) * this.around + j, (i + 1) * this.around + k];
      triangles.push(a, c, b, b, c, e);
    }
    this.count = triangles.length;
    this.sheet = gl.createBuffer();
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(triangles), gl.STATIC_DRAW);
  }

  listen() {
    const { canvas } = this, turn = (yaw, pitch) => {
      this.yaw += yaw; this.pitch = Math.min(Math.max(this.pitch + pitch, 0.12), 1.5); this.isStale = true;
    };
    let last = null;
    canvas.addEventListener("pointerdown", (event) => { last = event; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointermove", (event) => { if (last) { turn((event.clientX - last.clientX) / 150, (event.clientY - last.clientY) / 150); last = event; } });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
    const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    canvas.addEventListener("keydown", (event) => { if (keys[event.key]) { turn(...keys[event.key]); event.preventDefault(); event.stopPropagation(); } });
  }

  /** Draw, if anything has changed. */
  draw({ sample, kind }) {
    if (!this.gl || this.gl.isContextLost()) return;
    const touch = sample?.contact && sample.x !== null && kind !== "misfit" ? sample : null;
    const key = touch ? `${touch.x.toFixed(2)} ${touch.y.toFixed(2)} ${touch.force.toFixed(3)} ${kind}` : "";
    if (!fit(this.canvas, this.finest) && !this.isStale && key === this.key) return;
    [this.key, this.isStale] = [key, false];
    const { gl } = this;
    this.deflection?.press(touch?.x ?? 0, touch?.y ?? 0, touch ? Math.max(touch.force, 0) : 0);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...rgb(theme.fill), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.setCamera();
    this.drawSheet();
    this.drawLines();
    if (touch) this.drawProbe(touch, kind);
    this.sayCaption(touch);
  }

  setCamera() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const aspect = this.canvas.width / this.canvas.height;
    // Rows of the view: right, up, towards the viewer; orthographic, so that the film stays to scale.
    const right = [cy, sy, 0], up = [-sy * sp, cy * sp, cp], toward = [-sy * cp * -1, cy * cp * -1, sp];
    const high = this.radius * Math.max(0.36 + 0.66 * sp, 1.08 / aspect), wide = high * aspect, deep = 4 * this.radius;
    const lift = -0.06 * this.radius;
    const rows = [right.map((v) => v / wide), up.map((v) => v / high), toward.map((v) => -v / deep)];
    const m = new Float32Array(16);
    for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) m[4 * c + r] = rows[r][c];
    m[13] = -lift / high; m[15] = 1;
    this.gl.uniformMatrix4fv(this.uniform.camera, false, m);
    this.gl.uniform3fv(this.uniform.light, normalised([0.35 * right[0] + 0.5 * up[0] + toward[0], 0.35 * right[1] + 0.5 * up[1] + toward[1], 0.35 * right[2] + 0.5 * up[2] + toward[2]]));
  }

  height(x, y) { return this.deflection ? -STRETCH * this.deflection.at(x, y) : 0; }

  drawSheet() {
    const { gl, nodes, rings, around, deflection } = this, places = [];
    for (let i = 0; i < rings; i++) for (let j = 0; j < around; j++) {
      const phi = 2 * Math.PI * j / around;
      if (deflection) { const [x, y, w] = deflection.node(i, phi); places.push([x, y, -STRETCH * w]); } else {
        const s = FLAT_RINGS[i] * this.radius; places.push([s * Math.cos(phi), s * Math.sin(phi), 0]);
      }
    }
    const deepest = STRETCH * (deflection?.largest ?? 1);
    for (let i = 0; i < rings; i++) for (let j = 0; j < around; j++) {
      const at = i * around + j, p = places[at];
      const along = minus(places[Math.min(i + 1, rings - 1) * around + j], places[Math.max(i - 1, 0) * around + j]);
      const across = minus(places[i * around + (j + 1) % around], places[i * around + (j + around - 1) % around]);
      const n = i === 0 ? [0, 0, 1] : normalised(cross(along, across));
      nodes.set([...p, ...n, -p[2] / deepest], 7 * at);
    }
    this.fill(this.sheet, nodes);
    gl.uniform3fv(this.uniform.flat_colour, rgb(theme.flat)); gl.uniform3fv(this.uniform.deep_colour, rgb(theme.deep)); gl.uniform1f(this.uniform.lit, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.order);
    gl.enable(gl.POLYGON_OFFSET_FILL); gl.polygonOffset(1, 1);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  drawLines() {
    const rim = Array.from({ length: 97 }, (_, k) => [this.radius * Math.cos(k * Math.PI / 48), this.radius * Math.sin(k * Math.PI / 48)]);
    this.line(rim, theme.quiet);
    this.line(closed(this.film.working_area_mm), theme.accent);
    this.film.electrodes.forEach((name, k) => {
      for (const polygon of this.film.polygons_mm[name] ?? []) this.line(closed(polygon), lineStyle(k).colour);
    });
  }

  line(points, colour) {
    const fine = points.flatMap(([x, y], k) => k === 0 ? [[x, y]] : [0.25, 0.5, 0.75, 1].map((s) => [points[k - 1][0] * (1 - s) + x * s, points[k - 1][1] * (1 - s) + y * s]));
    this.solid(this.gl.LINE_STRIP, fine.map(([x, y]) => [x, y, this.height(x, y) + 0.12]), colour);
  }

  /** An arrow that ends where the probe is; only its outline where that is no confident contact. */
  drawProbe({ x, y, force }, kind) {
    const foot = this.height(x, y) + 0.3, length = 9 + 14 * Math.sqrt(Math.min(force / this.film.force_range_N[1], 1.5)), sides = 14, solid = [];
    const ring = (r, z) => Array.from({ length: sides + 1 }, (_, k) => [x + r * Math.cos(2 * Math.PI * k / sides), y + r * Math.sin(2 * Math.PI * k / sides), z]);
    const [tip, neck, top] = [[x, y, foot], foot + 5, foot + length], [wide, thin, end] = [ring(2, neck), ring(0.75, neck), ring(0.75, top)];
    for (let k = 0; k < sides; k++) {
      solid.push(tip, wide[k], wide[k + 1], wide[k], wide[k + 1], thin[k], thin[k], wide[k + 1], thin[k + 1]);
      solid.push(thin[k], thin[k + 1], end[k], end[k], thin[k + 1], end[k + 1], end[k], end[k + 1], [x, y, top]);
    }
    const { gl } = this, sure = kind === "contact";
    this.solid(sure ? gl.TRIANGLES : gl.LINES, solid, sure ? theme.touch : theme.warn);
  }

  solid(mode, points, colour) {
    const data = new Float32Array(points.length * 7);
    points.forEach((point, k) => data.set([...point, 0, 0, 1, 0], 7 * k));
    this.fill(this.points, data);
    this.gl.uniform3fv(this.uniform.flat_colour, rgb(colour)); this.gl.uniform1f(this.uniform.lit, 0);
    this.gl.drawArrays(mode, 0, points.length);
  }

  fill(buffer, data) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    [[0, 3, 0], [1, 3, 12], [2, 1, 24]].forEach(([k, size, offset]) => gl.vertexAttribPointer(k, size, gl.FLOAT, false, 28, offset));
  }

  sayCaption(touch) {
    const words = this.deflection
      ? `${touch ? `about ${this.deflection.at(touch.x, touch.y).toFixed(1)} mm deep under the probe; ` : ""}depth drawn ${STRETCH} times`
      : "The model does not describe its film: the place alone.";
    if (this.caption.textContent !== words) this.caption.textContent = words;
  }
}

/** Whether WebGL is drawn without a graphics card: then smooth edges cost more than they are worth. */
function isDrawnByProcessor() {
  const probe = document.createElement("canvas").getContext("webgl"), names = probe?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? probe.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

function closed(points) { return [...points, points[0]]; }

function minus(a, b) { return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]; }

function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }

function normalised(v) { const size = Math.hypot(...v) || 1; return v.map((c) => c / size); }
