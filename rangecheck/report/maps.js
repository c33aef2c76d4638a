/* Distance maps: the value under the cursor, in millimetres, from the focal points of the job or, computed here, from any other. */
(() => {
  const canvas = byId("map");
  if (!canvas) return;
  const value = byId("map-value"), where = byId("map-place"), context = canvas.getContext("2d");
  let map = null, cursor = null, picture = null;

  /** World place of pixel (u, v) at `distance` along its ray. */
  const placeOf = (u, v, distance) => {
    if (!map.intrinsics) return null;
    const [fx, fy, cx, cy] = map.intrinsics, ray = [(u - cx) / fx, (v - cy) / fy, 1], scale = distance / Math.hypot(...ray);
    return [0, 1, 2].map((k) => map.pose[k][3] + scale * (map.pose[k][0] * ray[0] + map.pose[k][1] * ray[1] + map.pose[k][2] * ray[2]));
  };
  const here = () => (cursor ? map.values[cursor[1] * map.width + cursor[0]] : NaN);
  const redraw = () => {
    context.putImageData(picture, 0, 0);
    if (!cursor) return;
    const [u, v] = cursor, arm = Math.max(5, map.width / 40);
    for (const [colour, width] of [["rgba(0,0,0,.75)", 3], ["#fff", 1.2]]) {
      context.strokeStyle = colour; context.lineWidth = (width * map.width) / 512;
      context.beginPath();
      context.moveTo(u - arm, v + 0.5); context.lineTo(u + arm + 1, v + 0.5); context.moveTo(u + 0.5, v - arm); context.lineTo(u + 0.5, v + arm + 1);
      context.stroke();
    }
  };
  const tellValue = () => {
    redraw();
    const distance = here();
    canvas.dataset.pixel = cursor ? cursor.join(",") : "";
    if (!cursor) { value.textContent = "–"; where.textContent = "Point at the map to measure."; return; }
    value.textContent = Number.isNaN(distance) ? "nothing" : `${distance.toFixed(2)} mm`;
    const place = Number.isNaN(distance) ? null : placeOf(cursor[0], cursor[1], distance);
    where.textContent = `column ${cursor[0]}, row ${cursor[1]}${place ? `: ${point(place)}` : ""}`;
  };
  const show = (next, name, about) => {
    map = next;
    canvas.width = map.width; canvas.height = map.height;
    let low = Infinity, high = -Infinity;
    for (const x of map.values) { if (x < low) low = x; if (x > high) high = x; }
    if (!(low <= high)) { low = 0; high = 1; }
    picture = context.createImageData(map.width, map.height);
    map.values.forEach((x, i) => { if (!Number.isNaN(x)) picture.data.set([...colourAt("viridis", 1 - (x - low) / (high - low || 1)), 255], 4 * i); });
    const eye = map.pose.slice(0, 3).map((row) => row[3]);
    byId("map-legend").replaceChildren();
    drawScale(byId("map-legend"), "viridis", high, low, "mm", `Focal point at ${point(eye)}. ${map.width} × ${map.height} pixels, ${about}.`);
    if (cursor) cursor = [Math.min(cursor[0], map.width - 1), Math.min(cursor[1], map.height - 1)];
    canvas.dataset.map = name;
    tellValue();
  };
  const choose = async (index) => {
    const next = data.maps[index];
    next.values ||= await unpackedFloats(next.distance);
    show(next, String(index), `in steps of ${short(next.distance.step)} mm`);
  };
  canvas.addEventListener("pointermove", (e) => {
    if (!map) return;
    // the picture keeps its shape inside the canvas' box
    const box = canvas.getBoundingClientRect(), scale = Math.min(box.width / map.width, box.height / map.height);
    const u = Math.floor((e.clientX - box.left - (box.width - scale * map.width) / 2) / scale), v = Math.floor((e.clientY - box.top - (box.height - scale * map.height) / 2) / scale);
    if (u < 0 || v < 0 || u >= map.width || v >= map.height) return;
    cursor = [u, v];
    tellValue();
  });
  const mark = () => { const distance = here(), place = Number.isNaN(distance) ? null : placeOf(cursor[0], cursor[1], distance); if (place && data.model) tell("place", place); };
  canvas.addEventListener("click", mark);
  canvas.addEventListener("keydown", (e) => {
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
    if (!map) return;
    if (arrow) {
      const by = e.shiftKey ? 10 : 1, from = cursor || [map.width >> 1, map.height >> 1];
      cursor = [Math.max(0, Math.min(map.width - 1, from[0] + by * arrow[0])), Math.max(0, Math.min(map.height - 1, from[1] + by * arrow[1]))];
      tellValue();
    } else if (e.key === "Enter") mark();
    else return;
    e.preventDefault();
  });
  const other = byId("focal-other");
  for (const radio of document.querySelectorAll('input[name="focal"]')) radio.addEventListener("change", () => (radio === other ? measure() : choose(Number(radio.value))));
  choose(0);

  // from anywhere: the focal point looks at the bust's middle, with the field of view of the job's maps
  const like = data.maps.find((one) => one.intrinsics), anywhere = byId("anywhere");
  if (!anywhere || !like) return;
  const inputs = ["azimuth", "elevation", "distance"].map((name) => byId(`focal-${name}`)), status = byId("focal-status");
  const middle = data.model.low.map((x, k) => (x + data.model.high[k]) / 2), radians = Math.PI / 180;
  /** Pose at `eye` that looks at the middle: columns right, down, forward, eye. */
  const poseAt = (eye) => {
    const unit = (a) => a.map((x) => x / Math.hypot(...a)), cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const forward = unit(middle.map((x, k) => x - eye[k])), right = unit(cross(forward, [0, 1, 0])), down = cross(forward, right);
    return [0, 1, 2].map((k) => [right[k], down[k], forward[k], eye[k]]).concat([[0, 0, 0, 1]]);
  };
  const measure = () => {
    const [azimuth, elevation, distance] = inputs.map((input) => (input.value === "" ? NaN : Number(input.value)));
    other.checked = true;
    const wrong = inputs.find((input) => input.value === "" || !input.checkValidity());
    if (wrong) { status.textContent = `${wrong.labels[0].textContent.trim()}: ${wrong.min} to ${wrong.max}.`; return; }
    const a = (azimuth + data.front) * radians, e = elevation * radians;
    const pose = poseAt([Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)].map((x, k) => middle[k] + distance * x));
    const { values, inside } = offers.distances(pose, like.intrinsics, like.width, like.height);
    status.textContent = inside ? "The focal point lies inside the bust." : "";
    show({ ...like, pose, values: inside ? values.fill(NaN) : values }, "other", data.model.exactness);
  };
  for (const input of inputs) input.addEventListener("input", measure);
  byId("focal-view").addEventListener("click", () => {
    const { azimuth, elevation, distance, target } = JSON.parse(byId("view").dataset.pose), a = azimuth * radians, e = elevation * radians;
    const [x, y, z] = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)].map((way, k) => target[k] + distance * way - middle[k]), away = Math.hypot(x, y, z);
    const seen = [((Math.atan2(x, z) / radians - data.front + 540) % 360) - 180, Math.asin(y / away) / radians, away];
    inputs.forEach((input, k) => { input.value = seen[k].toFixed(1); });
    measure();
  });
  const offered = () => {
    const eye = like.pose.slice(0, 3).map((row, k) => row[3] - middle[k]), away = Math.hypot(...eye);
    inputs[1].value = ((Math.asin(eye[1] / away) / radians)).toFixed(1);
    inputs[2].value = away.toFixed(0);
    anywhere.hidden = other.parentElement.hidden = false;
  };
  if (offers.distances) offered(); else when("distances", offered);
})();
