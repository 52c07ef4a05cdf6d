"""Checks of a finished run with the programs that people use: tifffile, GDAL (rasterio), rio-cogeo, Pillow.

    map_products.py CHECK RUN ADIT
"""
import json
import os
import re
import subprocess
import sys
import tempfile

LAYERS = ["color", "intensity", "labels", "offset", "coverage", "distortion", "relief", "roughness", "design_offset", "xyz",
          "surface_point"]


def way_back(run, _):
    """From a pixel to scan coordinates with tifffile only: sample + offset of the band."""
    import numpy as np
    import tifffile
    with tifffile.TiffFile(f"{run}/map/xyz.tif") as tif:
        xyz = tif.pages[0].asarray().astype("f8")
        offsets = [float(x) for x in re.findall(r'name="OFFSET"[^>]*>([^<]+)<', tif.pages[0].tags[42112].value)]
    assert len(offsets) == 3 and offsets[1] > 6e6, offsets
    scan = xyz + offsets
    # The axis is inside: every pixel lies within the tunnel's radius of it.
    axis = np.genfromtxt(f"{run}/axis.csv", delimiter=",", skip_header=1)
    legend = json.load(open(f"{run}/map/legend.json"))
    rows, columns = np.nonzero(~np.isnan(xyz[..., 0]))
    u = legend["u_min_m"] + (columns + 0.5) * legend["cell_m"]
    axis_at = np.stack([np.interp(u, axis[:, 0], axis[:, k]) for k in (1, 2, 3)], 1)
    distance = np.linalg.norm(scan[rows, columns] - axis_at, axis=1)
    assert 0.5 < distance.min() and distance.max() < 6.0, (distance.min(), distance.max())
    # Neighbouring pixels are as far apart in the tunnel as on the map, but for the distortion.
    step = np.linalg.norm(np.diff(scan, axis=1), axis=2)
    assert abs(np.nanmedian(step) / legend["cell_m"] - 1) < 0.05, np.nanmedian(step)
    print(f"tifffile: {len(rows)} pixels lead back to the scan")


def gdal(run, _):
    """Pixel (0, 0), size, nodata, band names, and layers that line up."""
    import numpy as np
    import rasterio
    legend = json.load(open(f"{run}/map/legend.json"))
    cell = legend["cell_m"]
    for layer in LAYERS:
        with rasterio.open(f"{run}/map/{layer}.tif") as r:
            t = r.transform
            assert abs(t.c - legend["u_min_m"]) < 1e-9 and abs(t.f - legend["v_max_m"]) < 1e-9, (layer, t)
            assert abs(t.a - cell) < 1e-12 and abs(t.e + cell) < 1e-12 and t.b == t.d == 0, (layer, t)
            assert (r.width, r.height) == (legend["width_px"], legend["height_px"])
            entry = next(l for l in legend["layers"] if l["layer"] == layer)
            assert list(r.descriptions) == entry["bands"], (layer, r.descriptions)
            assert len(r.overviews(1)) >= 1 and r.is_tiled
            u, v = r.xy(0, 0)
            assert abs(u - legend["u_min_m"] - cell / 2) < 1e-9 and abs(v - legend["v_max_m"] + cell / 2) < 1e-9
            if layer == "xyz":
                assert list(r.offsets) == entry["band_offsets"], r.offsets
            # The picture beside it lies on the same place.
            png = f"{run}/map/{layer}.png"
            if os.path.exists(png):
                with rasterio.open(png) as p:
                    assert abs(p.transform.c - t.c) < cell / 2 and abs(p.transform.f - t.f) < cell / 2
                    assert (p.width, p.height) == (r.width, r.height)
    read = lambda layer: rasterio.open(f"{run}/map/{layer}.tif").read(masked=True)
    # Layers line up: where there is no surface, none has a value.
    surface = read("coverage")[0].filled(0) > 0
    for layer in ("offset", "distortion", "xyz", "surface_point", "labels", "relief"):
        valid = ~np.ma.getmaskarray(read(layer)[0]) & ~np.isnan(read(layer)[0].astype("f8").filled(np.nan))
        assert (valid == surface).all(), (layer, (valid != surface).sum())
    print(f"GDAL {rasterio.__gdal_version__}: {len(LAYERS)} layers in place")


def cog(run, _):
    from rio_cogeo.cogeo import cog_validate
    for layer in LAYERS:
        ok, errors, warnings = cog_validate(f"{run}/map/{layer}.tif", strict=True)
        assert ok and not errors and not warnings, (layer, errors, warnings)
    print(f"rio-cogeo: {len(LAYERS)} cloud optimized GeoTIFFs")


def paint(run, adit):
    """Strokes of 3 pixels and fills, drawn with Pillow on two pictures, saved in many ways, and given back."""
    import numpy as np
    from PIL import Image, ImageDraw
    classes = {c["value"]: tuple(c["color"]) for c in json.load(open(f"{run}/map/labels.json"))["classes"]}
    names = {c["name"]: c["value"] for c in json.load(open(f"{run}/map/labels.json"))["classes"]}
    labels = np.array(Image.open(f"{run}/map/labels.png").convert("RGBA"))
    surface = labels[..., 3] > 0

    def to_labels(pixels):
        found = np.full(pixels.shape[:2], -1)
        for value, color in classes.items():
            found[(pixels[..., :3] == color).all(-1) & (pixels[..., 3] > 0)] = value
        return found

    before = to_labels(labels)
    for base in ("labels", "color"):
        image = Image.open(f"{run}/map/{base}.png").convert("RGBA")
        width, height = image.size
        truth = Image.new("I", image.size, -1)
        pen, mark = ImageDraw.Draw(image), ImageDraw.Draw(truth)
        rng = np.random.default_rng(5)
        some = [v for v in classes if v][:5]
        for k in range(10):
            value = some[k % len(some)]
            points = [tuple(rng.uniform(0.15, 0.6, 2) * image.size)]
            for _ in range(4):
                x, y = points[-1]
                points.append((x + rng.uniform(-0.05, 0.1) * width, y + rng.uniform(-0.08, 0.08) * height))
            pen.line(points, fill=classes[value] + (255,), width=3)
            mark.line(points, fill=value, width=3)
        for k in range(3):
            value = some[k]
            x, y = rng.uniform(0.2, 0.75, 2) * image.size
            pen.ellipse((x - 20, y - 20, x + 20, y + 20), fill=classes[value] + (255,))
            mark.ellipse((x - 20, y - 20, x + 20, y + 20), fill=value)
        truth = np.where(surface, np.array(truth), -1)
        double = (2 * width, 2 * height)
        crop = (width // 8, height // 8, width * 7 // 8, height * 7 // 8)
        half = (round(width / 2), round(height / 2))
        versions = [
            ("same.png", image, {}, 0.999),
            ("bilinear.png", image.resize(half, Image.BILINEAR), {}, 0.97),
            ("half.png", image.resize(half, Image.BICUBIC), {}, 0.97),
            ("lanczos.png", image.convert("RGB").resize(half, Image.LANCZOS), {}, 0.97),
            ("double.png", image.resize(double, Image.BICUBIC), {}, 0.99),
            ("palette.png", image.convert("RGB").quantize(256), {}, 0.97),
            ("octree.png", image.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE), {}, 0.97),
            ("jpeg.jpg", image.convert("RGB"), {"quality": 85}, 0.95),
            ("crop.png", image.crop(crop), {}, 0.999),
        ]
        for name, version, options, least in versions:
            with tempfile.TemporaryDirectory() as folder:
                path = f"{folder}/{name}"
                version.save(path, **options)
                part = (slice(None), slice(None))
                if name == "crop.png":
                    lines = open(f"{run}/map/{base}.pgw").read().split()
                    step = float(lines[0])
                    lines[4] = str(float(lines[4]) + crop[0] * step)
                    lines[5] = str(float(lines[5]) - crop[1] * step)
                    open(f"{folder}/crop.pgw", "w").write("\n".join(lines) + "\n")
                    part = (slice(crop[1], crop[3]), slice(crop[0], crop[2]))
                command = [adit, "lift", run, "--labels", path, "--out", f"{folder}/p.laz", "--recognised", f"{folder}/r.png"]
                done = subprocess.run(command, capture_output=True, text=True)
                assert done.returncode == 0, (base, name, done.stderr)
                found = to_labels(np.array(Image.open(f"{folder}/r.png").convert("RGBA")))
                assert found.shape == before[part].shape, (base, name, found.shape)
                # Only a palette may lose a colour, and only with a word; what is left is held to the same bounds.
                lost = {names[n] for n in re.findall("has no colour for (.+): what", done.stdout)} & set(some)
                assert not lost or name == "palette.png", (base, name, lost)
                judged = ~np.isin(truth[part], list(lost))
                assert judged[truth[part] >= 0].mean() > 0.85, (base, name, lost)
                changed = (found != before[part]) & judged
                expected = (truth[part] >= 0) & (truth[part] != before[part]) & judged
                right = changed & expected & (found == truth[part])
                iou = right.sum() / (changed | expected).sum()
                wrong = (changed & expected & (found != truth[part]) & (truth[part] >= 0)).sum()
                print(f"Pillow, {base}, {name}: IoU {iou:.3f}, {wrong} of {expected.sum()} in another class")
                assert iou >= least, (base, name, iou, done.stdout)
                # Where strokes of two classes cross, a pixel of a resized picture holds both.
                assert wrong <= 0.002 * expected.sum(), (base, name, wrong, done.stdout)


if __name__ == "__main__":
    check, run, adit = sys.argv[1:]
    {"way_back": way_back, "gdal": gdal, "cog": cog, "paint": paint}[check](run, adit)
