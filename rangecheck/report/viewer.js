/* The bust in three dimensions: coloured by what is known of it, cut by a plane, marked where findings are. */
const SEVERITIES = ["none", "note", "warning", "error"];
const SEVERITY_RGB = { none: [214, 208, 196], note: [90, 130, 190], warning: [226, 160, 40], error: [205, 50, 35] };
const ORIGIN_RGB = [[128, 172, 134], [232, 190, 92], [196, 88, 72], [84, 128, 186]];
const PLAIN_RGB = [222, 217, 207], NONE_RGB = [150, 148, 143];
const SPREAD = 2 * Math.tan((25 * Math.PI) / 360);

/** three.js, its two modules linked to each other: they are embedded as published, and a page that is one file has no addresses for them. */
async function library() {
  const [core, main] = (await Promise.all(data.library.map(inflated))).map((bytes) => new TextDecoder().decode(bytes));
  const address = (text) => URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  return import(address(main.replaceAll('"./three.core.min.js"', JSON.stringify(address(core)))));
}

async function readModel() {
  const m = data.model, [p, n, faces, origin] = await Promise.all([m.positions, m.normals, m.faces, m.origin].map(unpacked));
  const positions = new Float32Array(p.length), normals = new Float32Array(p.length);
  for (let i = 0; i < p.length; i++) positions[i] = m.low[i % 3] + p[i] * m.step;
  for (let i = 0; i < n.length / 2; i++) {
    let x = n[2 * i] / 2047.5 - 1, y = n[2 * i + 1] / 2047.5 - 1;
    const z = 1 - Math.abs(x) - Math.abs(y), t = Math.max(0, -z);
    x -= x >= 0 ? t : -t; y -= y >= 0 ? t : -t;
    const length = Math.hypot(x, y, z) || 1;
    normals.set([x / length, y / length, z / length], 3 * i);
  }
  const fields = Object.fromEntries(await Promise.all(m.fields.map(async (f) => [f.key, { ...f, values: await unpackedFloats(f.values) }])));
  return { positions, normals, faces, origin, fields, flagged: m.flagged && (await unpacked(m.flagged)) };
}

async function startViewer() {
  const canvas = byId("view"), status = byId("view-status"), legend = byId("view-legend"), reading = byId("view-reading");
  const [THREE, model] = await Promise.all([library(), readModel()]);
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, stencil: true, preserveDrawingBuffer: true });
  renderer.localClippingEnabled = true;
  const { low, high } = data.model, middle = low.map((x, k) => (x + high[k]) / 2), radius = Math.hypot(...low.map((x, k) => high[k] - x)) / 2;

  const shape = new THREE.BufferGeometry(), count = model.positions.length / 3;
  shape.setAttribute("position", new THREE.BufferAttribute(model.positions, 3));
  shape.setAttribute("normal", new THREE.BufferAttribute(model.normals, 3));
  shape.setAttribute("color", new THREE.BufferAttribute(new Float32Array(model.positions.length), 3));
  shape.setIndex(new THREE.BufferAttribute(model.faces, 1));
  const cut = new THREE.Plane(new THREE.Vector3(0, 0, -1), 0);
  const { closed } = data.model;
  const skin = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.85, side: closed ? THREE.DoubleSide : THREE.FrontSide });
  // a sliver that simplification turned over is still skin: it is lit by the normals of its corners, whichever way it faces
  skin.onBeforeCompile = (shader) => { shader.fragmentShader = shader.fragmentShader.replace("#include <normal_fragment_begin>", "float faceDirection = 1.0; vec3 normal = normalize( vNormal ); vec3 nonPerturbedNormal = normal;"); };
  const inside = new THREE.MeshBasicMaterial({ side: THREE.BackSide });
  // the section of a closed surface: the plane wherever a ray through the pixel leaves the surface more often than it enters it
  const tally = (side, change) => new THREE.MeshBasicMaterial({ side, depthTest: false, depthWrite: false, colorWrite: false, stencilWrite: true, stencilFail: change, stencilZFail: change, stencilZPass: change, clippingPlanes: [] });
  const counted = [tally(THREE.BackSide, THREE.IncrementWrapStencilOp), tally(THREE.FrontSide, THREE.DecrementWrapStencilOp)];
  const face = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, stencilWrite: true, stencilFunc: THREE.NotEqualStencilFunc, stencilFail: THREE.ReplaceStencilOp, stencilZFail: THREE.ReplaceStencilOp, stencilZPass: THREE.ReplaceStencilOp });
  const cap = new THREE.Mesh(new THREE.PlaneGeometry(4 * radius, 4 * radius), face);
  const capped = new THREE.Group();
  capped.add(...counted.map((material) => new THREE.Mesh(shape, material)), cap);
  capped.children.forEach((part, k) => { part.renderOrder = 1 + k; });
  capped.visible = false;
  const bust = new THREE.Mesh(shape, skin);
  const marks = new THREE.Group();
  marks.renderOrder = 9;
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, 1, radius / 100, radius * 20), lamp = new THREE.DirectionalLight(0xffffff, 2.3);
  const back = new THREE.Mesh(shape, inside);
  back.visible = !closed;
  scene.add(bust, back, capped, marks, new THREE.HemisphereLight(0xffffff, 0x9a948a, 1.35), camera);
  lamp.position.set(-0.5, 0.7, 1); camera.add(lamp, lamp.target); lamp.target.position.set(0, 0, -1);

  let wanted = 0, quiet = 0;
  const draw = () => {
    wanted = 0;
    camera.position.set(...orbit.eye());
    camera.lookAt(...orbit.target);
    renderer.render(scene, camera);
  };
  const redraw = () => { wanted ||= requestAnimationFrame(draw); };
  const orbit = new Orbit(canvas, () => {
    redraw();
    tell("azimuth", orbit.azimuth - data.front, follow);
    canvas.dataset.pose = JSON.stringify({ azimuth: orbit.azimuth, elevation: orbit.elevation, distance: orbit.distance, target: orbit.target });
    clearTimeout(quiet);
    quiet = setTimeout(() => { status.textContent = `Seen from azimuth ${Math.round(orbit.azimuth - data.front + 720) % 360}°, elevation ${Math.round(orbit.elevation)}°, ${Math.round(orbit.distance)} mm before ${point(orbit.target)}.`; }, 300);
  });
  const follow = (azimuth) => { orbit.azimuth = (((azimuth + data.front) % 360) + 360) % 360; redraw(); };
  when("azimuth", follow);
  orbit.home = { azimuth: ((data.front % 360) + 360) % 360, elevation: 8, distance: (1.04 * radius) / Math.sin((25 * Math.PI) / 360), target: middle, spread: SPREAD };
  Object.assign(orbit, { azimuth: orbit.home.azimuth, distance: orbit.home.distance, target: [...middle] });
  byId("view-home").addEventListener("click", () => orbit.fly(orbit.home));

  const linear = (v) => { const c = v / 255; return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
  const colourOf = (mode) => {
    if (mode === "origin") return (i) => ORIGIN_RGB[model.origin[i]];
    if (mode === "findings") return (i) => SEVERITY_RGB[SEVERITIES[model.flagged ? model.flagged[i] : 0]];
    const field = model.fields[mode];
    if (!field) return () => PLAIN_RGB;
    return (i) => { const v = field.values[i]; return Number.isNaN(v) ? NONE_RGB : colourAt(field.colours, (v - field.from) / (field.to - field.from)); };
  };
  const swatches = (rows) => {
    const list = document.createElement("ul");
    for (const [rgb, label] of rows) { const row = document.createElement("li"), patch = document.createElement("i"); patch.style.background = `rgb(${rgb})`; row.append(patch, label); list.append(row); }
    legend.replaceChildren(list);
  };
  let mode = "plain";
  const paint = (chosen) => {
    mode = chosen;
    const colours = shape.getAttribute("color"), of = colourOf(mode);
    for (let i = 0; i < count; i++) { const c = of(i); colours.setXYZ(i, linear(c[0]), linear(c[1]), linear(c[2])); }
    colours.needsUpdate = true;
    const field = model.fields[mode];
    if (field) drawScale(legend, field.colours, field.from, field.to, field.unit, field.about);
    else if (mode === "origin") swatches(data.model.origins.map((name, k) => [ORIGIN_RGB[k], name]));
    else if (mode === "findings") swatches(["error", "warning", "note"].filter((s) => data.findings.some((f) => f.severity === s)).map((s) => [SEVERITY_RGB[s], s]).concat(data.findings.length ? [] : [[SEVERITY_RGB.none, "no finding"]]));
    else legend.replaceChildren();
    markFindings();
    redraw();
  };
  for (const button of document.querySelectorAll('input[name="colour"]')) button.addEventListener("change", () => paint(button.value));

  const dot = document.createElement("canvas");
  dot.width = dot.height = 64;
  const pen = dot.getContext("2d");
  pen.arc(32, 32, 24, 0, 7); pen.fillStyle = "#fff"; pen.fill(); pen.lineWidth = 8; pen.strokeStyle = "#000"; pen.stroke();
  const disc = new THREE.CanvasTexture(dot);
  const spots = (places, rgb, size) => {
    const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(places.flat(), 3));
    return new THREE.Points(geometry, new THREE.PointsMaterial({ map: disc, color: new THREE.Color(...rgb.map(linear)), size: size * devicePixelRatio, sizeAttenuation: false, transparent: true, alphaTest: 0.3, depthTest: false }));
  };
  let chosenFinding = null, picked = null;
  const markFindings = () => {
    marks.clear();
    data.findings.forEach((f, k) => { if (f.places.length && (mode === "findings" || k === chosenFinding)) marks.add(spots(f.places, SEVERITY_RGB[f.severity], k === chosenFinding ? 13 : 9)); });
    if (picked) marks.add(spots([picked], [40, 110, 220], 16));
  };

  const nearest = (place) => {
    let best = 0, least = Infinity;
    for (let i = 0; i < count; i++) {
      const d = (model.positions[3 * i] - place[0]) ** 2 + (model.positions[3 * i + 1] - place[1]) ** 2 + (model.positions[3 * i + 2] - place[2]) ** 2;
      if (d < least) { least = d; best = i; }
    }
    return best;
  };
  const visit = (place) => {
    if (skin.clippingPlanes && cut.distanceToPoint(new THREE.Vector3(...place)) < 0) { document.querySelector('input[name="section"][value=""]').checked = true; section(); }
    const i = nearest(place), [x, y, z] = model.normals.subarray(3 * i, 3 * i + 3);
    orbit.fly({ azimuth: ((Math.atan2(x, z) * 180) / Math.PI + 360) % 360, elevation: Math.max(-80, Math.min(80, (Math.asin(y) * 180) / Math.PI)), distance: orbit.home.distance * 0.3, target: place });
    byId("view-frame").scrollIntoView({ block: "center", behavior: calm.matches ? "auto" : "smooth" });
    canvas.focus({ preventScroll: true });
  };
  for (const button of document.querySelectorAll("button.show")) {
    let next = 0;
    button.addEventListener("click", () => {
      const index = Number(button.dataset.finding), places = data.findings[index].places, place = places[next % places.length];
      next += 1;
      chosenFinding = index;
      if (places.length > 1) button.firstChild.data = `Show ${(next % places.length) + 1} of ${places.length}`;
      markFindings();
      visit(place);
    });
  }
  // a row is a large target; the button in it is what keys and screen readers find
  for (const row of document.querySelectorAll("tr.placed"))
    row.addEventListener("click", (e) => { if (!e.target.closest("button, a") && !String(getSelection())) row.querySelector("button.show").click(); });
  when("place", (place) => { picked = place; markFindings(); visit(place); });

  const slider = byId("cut"), cutAt = byId("cut-at"), flip = byId("cut-flip");
  const section = () => {
    const axis = document.querySelector('input[name="section"]:checked').value, whole = axis === "";
    slider.disabled = flip.disabled = whole;
    skin.clippingPlanes = inside.clippingPlanes = whole ? null : [cut];
    for (const material of counted) material.clippingPlanes = [cut];
    skin.needsUpdate = inside.needsUpdate = true;
    capped.visible = !whole && closed;
    if (whole) cutAt.textContent = "–";
    else {
      const k = Number(axis), at = low[k] + (slider.value / 1000) * (high[k] - low[k]), way = flip.checked ? 1 : -1;
      cut.normal.set(0, 0, 0).setComponent(k, way);
      cut.constant = -way * at;
      cutAt.textContent = `${tenth(at)} mm`;
      cap.position.set(...middle).setComponent(k, at);
      cap.rotation.set(k === 1 ? -Math.PI / 2 : 0, k === 0 ? Math.PI / 2 : 0, 0);
    }
    redraw();
  };
  for (const input of [slider, flip, ...document.querySelectorAll('input[name="section"]')]) input.addEventListener("input", section);

  const ray = new THREE.Raycaster(), spot = new THREE.Vector2();
  let asked = null;
  const read = () => {
    const e = asked;
    asked = null;
    if (!e || orbit.fingers.size) return;
    const box = canvas.getBoundingClientRect();
    spot.set((2 * (e.clientX - box.left)) / box.width - 1, 1 - (2 * (e.clientY - box.top)) / box.height);
    ray.setFromCamera(spot, camera);
    const hit = ray.intersectObject(bust).find((h) => !skin.clippingPlanes || cut.distanceToPoint(h.point) >= 0);
    if (!hit) { reading.textContent = ""; return; }
    if (capped.visible && hit.face.normal.dot(ray.ray.direction) > 0) {
      const place = ray.ray.intersectPlane(cut, new THREE.Vector3());
      reading.textContent = place ? `${point(place.toArray())} · section` : "";
      return;
    }
    const corners = [hit.face.a, hit.face.b, hit.face.c], at = corners.reduce((best, i) => {
      const d = hit.point.distanceToSquared(new THREE.Vector3().fromBufferAttribute(shape.getAttribute("position"), i));
      return d < best[0] ? [d, i] : best;
    }, [Infinity, corners[0]])[1];
    const words = [point(hit.point.toArray()), data.model.origins[model.origin[at]]], field = model.fields[mode];
    if (field) words.push(Number.isNaN(field.values[at]) ? `${field.label.toLowerCase()}: none` : `${field.label.toLowerCase()} ${short(field.values[at])} ${field.unit}`);
    reading.textContent = words.join(" · ");
  };
  canvas.addEventListener("pointermove", (e) => { if (!asked) requestAnimationFrame(read); asked = e; });
  canvas.addEventListener("pointerleave", () => { asked = null; reading.textContent = ""; });

  // distances from any focal point, by its pose (x right, y down, z forward) and inner parameters: which face is seen through each pixel's middle is
  // drawn, and where the ray meets its plane is reckoned, since what is drawn lies by shares of a pixel beside its place
  let gauging = null;
  const focal = new THREE.Camera();
  focal.matrixAutoUpdate = focal.matrixWorldAutoUpdate = false;
  const facesDrawn = () => {
    const apart = new THREE.BufferGeometry(), places = new Float32Array(3 * model.faces.length);
    model.faces.forEach((i, k) => { for (let j = 0; j < 3; j++) places[3 * k + j] = model.positions[3 * i + j]; });
    apart.setAttribute("position", new THREE.BufferAttribute(places, 3));
    apart.setAttribute("face", new THREE.BufferAttribute(Float32Array.from(model.faces, (_, k) => 1 + Math.floor(k / 3)), 1));
    const drawn = new THREE.Mesh(apart, new THREE.ShaderMaterial({
      side: THREE.DoubleSide, blending: THREE.NoBlending,
      vertexShader: "attribute float face; varying highp float seen; void main() { seen = face; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
      fragmentShader: "varying highp float seen; void main() { gl_FragColor = vec4(seen, 0.0, 0.0, 1.0); }",
    }));
    drawn.frustumCulled = false;
    return new THREE.Scene().add(drawn);
  };
  const distances = (pose, [fx, fy, cx, cy], width, height) => {
    gauging ||= facesDrawn();
    const eye = [0, 1, 2].map((k) => pose[k][3]), away = Math.hypot(...eye.map((x, k) => x - middle[k]));
    const near = Math.max(away - 1.01 * radius, radius / 2000), far = away + 1.01 * radius;
    focal.matrixWorld.set(...pose.flatMap(([x, y, z, at]) => [x, -y, -z, at]));
    focal.matrixWorldInverse.copy(focal.matrixWorld).invert();
    focal.projectionMatrix.set((2 * fx) / width, 0, 1 - (2 * cx + 1) / width, 0, 0, (2 * fy) / height, (2 * cy + 1) / height - 1, 0, 0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near), 0, 0, -1, 0);
    focal.projectionMatrixInverse.copy(focal.projectionMatrix).invert();
    const target = new THREE.WebGLRenderTarget(width, height, { type: THREE.FloatType, minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter });
    const texels = new Float32Array(4 * width * height), values = new Float32Array(width * height).fill(NaN);
    renderer.setRenderTarget(target);
    renderer.render(gauging, focal);
    renderer.readRenderTargetPixels(target, 0, 0, width, height, texels);
    renderer.setRenderTarget(null);
    target.dispose();
    let hits = 0, fronts = 0;
    const { positions, faces } = model;
    for (let v = 0; v < height; v++)
      for (let u = 0; u < width; u++) {
        const face = Math.round(texels[4 * ((height - 1 - v) * width + u)]) - 1;
        if (face < 0) continue;
        const [a, b, c] = [0, 1, 2].map((k) => { const i = 3 * faces[3 * face + k]; return [positions[i] - eye[0], positions[i + 1] - eye[1], positions[i + 2] - eye[2]]; });
        const p = b.map((x, k) => x - a[k]), q = c.map((x, k) => x - a[k]);
        const normal = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
        const seen = [(u - cx) / fx, (v - cy) / fy, 1], length = Math.hypot(...seen);
        const steep = [0, 1, 2].reduce((sum, k) => sum + (normal[k] * (pose[k][0] * seen[0] + pose[k][1] * seen[1] + pose[k][2] * seen[2])) / length, 0);
        // along a rim the plane may be met far beside its face
        const ends = [a, b, c].map((corner) => Math.hypot(...corner)), at = (normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2]) / steep;
        values[v * width + u] = Math.min(Math.max(...ends), Math.max(Math.min(...ends) - Math.hypot(...p) - Math.hypot(...q), at));
        hits += 1;
        fronts += steep < 0;
      }
    return { values, inside: closed && fronts < hits / 2 };
  };

  const look = () => { for (const material of [inside, face]) material.color.set(getComputedStyle(document.documentElement).getPropertyValue("--cut").trim()); redraw(); };
  dark.addEventListener("change", look);
  new ResizeObserver(() => {
    renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    camera.aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    camera.updateProjectionMatrix();
    redraw();
  }).observe(canvas);
  look();
  paint("plain");
  orbit.changed();
  canvas.dataset.ready = "yes";
  if (renderer.extensions.has("EXT_color_buffer_float")) { offers.distances = distances; tell("distances"); }
}

if (data.model) {
  startViewer().catch((error) => {
    byId("view-frame").hidden = byId("view-panel").hidden = true;
    byId("view-status").textContent = `The 3-D view cannot be shown here (${error.message}); it needs WebGL.`;
  });
}
