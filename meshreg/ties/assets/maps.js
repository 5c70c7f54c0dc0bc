// One picture in deep zoom with its points, and a magnifier: everything that speaks to OpenLayers.
// Coordinates outside of this file are metres east and north as the server gives them; inside they
// are counted from the picture's north-west corner.

const HALO = "rgba(0,0,0,.75)";
const LOOKS = {
  agrees: { color: "#3fd6a4", shape: "circle" },
  wrong: { color: "#ff8a3c", shape: "square" },
  plain: { color: "#ffffff", shape: "circle" },
  open: { color: "#ffe04a", shape: "circle" },
};

function ring(look, chosen) {
  const size = chosen ? 11 : 8;
  const stroke = (color, width) => new ol.style.Stroke({ color, width });
  const outline = (color, width) => {
    const line = stroke(color, width);
    return look.shape === "square"
      ? new ol.style.RegularShape({ points: 4, angle: Math.PI / 4, radius: size * 1.25, stroke: line })
      : new ol.style.Circle({ radius: size, stroke: line });
  };
  const cross = (color, width) =>
    new ol.style.RegularShape({ points: 4, radius: 4, radius2: 0, stroke: stroke(color, width) });
  return [
    new ol.style.Style({ image: outline(HALO, chosen ? 6 : 4.5) }),
    new ol.style.Style({ image: outline(look.color, chosen ? 3.5 : 2) }),
    new ol.style.Style({ image: cross(HALO, 3.5) }),
    new ol.style.Style({ image: cross(look.color, 1.4) }),
  ];
}

function label(text, look, chosen) {
  return new ol.style.Style({
    text: new ol.style.Text({
      text,
      font: `${chosen ? 700 : 600} 13px system-ui, sans-serif`,
      offsetX: chosen ? 14 : 11,
      offsetY: -11,
      textAlign: "left",
      fill: new ol.style.Fill({ color: look.color }),
      stroke: new ol.style.Stroke({ color: HALO, width: 3.5 }),
    }),
  });
}

const GHOST = [
  [HALO, 4.5],
  ["#ffe04a", 2],
].map(([color, width]) => new ol.style.Style({
  image: new ol.style.Circle({
    radius: 22,
    stroke: new ol.style.Stroke({ color, width, lineDash: [5, 5] }),
  }),
}));

export class Picture {
  // `on` holds what to call, with this picture first: clicked(place, id of a mark there), dragged(id, place),
  // pointed(place), viewed().
  constructor(side, about, version, on) {
    this.side = side;
    this.corner = [about.west, about.north];
    this.cell = about.cell;
    this.on = on;
    const width = about.columns * about.cell, height = about.rows * about.cell;
    this.extent = [0, -height, width, 0];
    this.projection = new ol.proj.Projection({ code: `meshreg:${side}`, units: "m", extent: this.extent });
    this.grid = new ol.tilegrid.TileGrid({
      extent: this.extent, origin: [0, 0], resolutions: about.resolutions, tileSize: 256,
    });
    this.url = `/tiles/${side}/{z}/{x}/{y}.png?v=${version}`;
    this.element = document.getElementById(side);
    this.points = new ol.source.Vector();
    this.ghosts = new ol.source.Vector();
    const marks = new ol.layer.Vector({
      source: this.points, updateWhileInteracting: true, updateWhileAnimating: true,
    });
    this.view = new ol.View({
      projection: this.projection, center: [width / 2, -height / 2], resolution: about.resolutions[0],
      minResolution: about.cell / 32, maxResolution: 4 * Math.max(...about.resolutions),
      constrainRotation: false, smoothResolutionConstraint: false,
    });
    this.map = new ol.Map({
      target: this.element, view: this.view,
      layers: [this.tiles(true), new ol.layer.Vector({ source: this.ghosts, style: GHOST }), marks],
      controls: [new ol.control.Zoom(), new ol.control.ScaleLine({ minWidth: 60, maxWidth: 120 })],
      interactions: ol.interaction.defaults.defaults({
        doubleClickZoom: false, altShiftDragRotate: false, pinchRotate: false, shiftDragZoom: false,
      }),
      moveTolerance: 3,
    });
    this.drag();
    this.map.on("click", (event) => this.clicked(event));
    this.map.on("pointermove", (event) => {
      if (event.dragging) return;
      this.element.style.cursor = this.near(event.pixel) ? "grab" : "";
      this.on.pointed(this, this.absolute(event.coordinate));
    });
    this.view.on("change", () => this.on.viewed(this));
    this.addLens();
  }

  tiles(interpolate) {
    return new ol.layer.Tile({
      source: new ol.source.XYZ({
        url: this.url, tileGrid: this.grid, projection: this.projection, wrapX: false, transition: 0,
        interpolate,
      }),
    });
  }

  addLens() {
    const box = document.createElement("div");
    box.className = "lens";
    this.element.append(box);
    this.lens = new ol.Map({
      target: box, controls: [], interactions: [], layers: [this.tiles(false)],
      view: new ol.View({
        projection: this.projection, center: this.view.getCenter(), resolution: this.cell / 4,
        minResolution: this.cell / 64, constrainRotation: false,
      }),
    });
    this.lensBox = box;
  }

  // The mark within reach of a pixel of the map, the nearest if there are several.
  near(pixel, reach = 10) {
    let best = null, least = reach;
    for (const feature of this.points.getFeatures()) {
      const [x, y] = this.map.getPixelFromCoordinate(feature.getGeometry().getCoordinates());
      const distance = Math.hypot(x - pixel[0], y - pixel[1]);
      if (distance <= least) { best = feature; least = distance; }
    }
    return best;
  }

  drag() {
    let feature = null, start = null, moved = false;
    this.map.addInteraction(new ol.interaction.Pointer({
      handleDownEvent: (event) => {
        feature = event.originalEvent.button ? null : this.near(event.pixel);
        start = event.pixel;
        moved = false;
        return Boolean(feature);
      },
      handleDragEvent: (event) => {
        moved ||= Math.hypot(event.pixel[0] - start[0], event.pixel[1] - start[1]) > 3;
        if (moved) feature.getGeometry().setCoordinates(event.coordinate);
        this.on.pointed(this, this.absolute(event.coordinate));
      },
      handleUpEvent: (event) => {
        if (moved) this.on.dragged(this, feature.getId(), this.absolute(event.coordinate));
        return false;
      },
    }));
  }

  clicked(event) {
    const now = performance.now(), [x, y] = event.pixel;
    const again = this.last && now - this.last.at < 350 && Math.hypot(x - this.last.x, y - this.last.y) < 6;
    this.last = { at: now, x, y };
    if (again) return; // the second half of a double click
    this.on.clicked(this, this.absolute(event.coordinate), this.near(event.pixel)?.getId());
  }

  absolute([x, y]) { return [x + this.corner[0], y + this.corner[1]]; }
  local([east, north]) { return [east - this.corner[0], north - this.corner[1]]; }
  centre() { return this.absolute(this.view.getCenter()); }
  contains(place) { return ol.extent.containsCoordinate(this.extent, this.local(place)); }

  // Where a place is on the screen, in CSS pixels of the window.
  pixel(place) {
    this.map.renderSync();
    const [x, y] = this.map.getPixelFromCoordinate(this.local(place));
    const box = this.element.getBoundingClientRect();
    return [x + box.left, y + box.top];
  }

  look(place, resolution, rotation) {
    this.view.setCenter(this.local(place));
    if (resolution) this.view.setResolution(resolution);
    if (rotation !== undefined) this.view.setRotation(rotation);
  }

  fit() { this.view.fit(this.extent, { padding: [18, 18, 18, 18] }); }

  magnify(place) {
    const view = this.lens.getView();
    view.setCenter(this.local(place));
    view.setRotation(this.view.getRotation());
    view.setResolution(Math.min(this.view.getResolution() / 2, this.cell / 4));
  }

  // Where the magnifier would cover what is pointed at, it goes to the other corner.
  clearLens(place) {
    const at = this.map.getPixelFromCoordinate(this.local(place)), size = this.map.getSize();
    if (!at || !size) return;
    const reach = this.lensBox.offsetWidth + 24;
    if (at[1] < size[1] - reach) this.lensBox.classList.remove("away");
    else if (at[0] > size[0] - reach) this.lensBox.classList.add("away");
    else if (at[0] < reach) this.lensBox.classList.remove("away");
  }

  showLens(shown) {
    this.lensBox.hidden = !shown;
    this.lens.updateSize();
  }

  // marks: [{id, text, place, look, chosen}]; ghost: a place, or null
  draw(marks, ghost) {
    this.points.clear(true);
    this.points.addFeatures(marks.map((mark) => {
      const feature = new ol.Feature(new ol.geom.Point(this.local(mark.place)));
      const look = LOOKS[mark.look];
      feature.setId(mark.id);
      feature.setStyle([...ring(look, mark.chosen), label(mark.text, look, mark.chosen)]);
      return feature;
    }));
    this.ghosts.clear(true);
    if (ghost) this.ghosts.addFeature(new ol.Feature(new ol.geom.Point(this.local(ghost))));
  }
}

// How the moving picture lies on the reference: reference = link.reference + R(angle) (shown - link.shown)
export function toShown(link, [east, north]) {
  const dx = east - link.reference[0], dy = north - link.reference[1];
  const c = Math.cos(link.angle), s = Math.sin(link.angle);
  return [link.shown[0] + c * dx + s * dy, link.shown[1] - s * dx + c * dy];
}

export function toReference(link, [x, y]) {
  const dx = x - link.shown[0], dy = y - link.shown[1];
  const c = Math.cos(link.angle), s = Math.sin(link.angle);
  return [link.reference[0] + c * dx - s * dy, link.reference[1] + s * dx + c * dy];
}
