//! The map for QGIS: a style for each raster, and a project that shows all layers at once.
//!
//! Paths in the project are relative, so the folder can be moved. Rasters and vectors share the map plane (chainage to
//! the right, girth up, metres), which has no EPSG code; the project therefore states no coordinate system.

use super::{Legend, LegendLayer, Look};
use std::fmt::Write;

/// The layer that is switched on: the first of these that there is.
const SHOWN: [&str; 4] = ["color", "intensity", "relief", "offset"];

/// Something in a project.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProjectLayer {
    /// Name in the list of layers.
    pub name: String,
    /// Path from the project, with `/`.
    pub path: String,
    /// Whether it holds lines or points instead of pixels.
    pub is_vector: bool,
}

/// A QGIS style file (`.qml`) for a raster of the map.
pub fn style(layer: &LegendLayer) -> String {
    format!(
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n\
         <qgis version=\"3.22.0\" styleCategories=\"Symbology\">\n{}</qgis>\n",
        pipe(layer)
    )
}

/// A QGIS project (`.qgs`) with the rasters of the legend (in the folder `map`) and the given vectors above them.
pub fn project(title: &str, legend: &Legend, vectors: &[ProjectLayer]) -> String {
    let rasters = legend.layers.iter().map(|l| ProjectLayer {
        name: l.layer.name().to_owned(),
        path: format!("map/{}.tif", l.layer.name()),
        is_vector: false,
    });
    let layers: Vec<ProjectLayer> = vectors.iter().cloned().chain(rasters).collect();
    let shown = SHOWN.into_iter().find(|n| layers.iter().any(|l| !l.is_vector && l.name == *n));
    let mut tree = String::new();
    let mut order = String::new();
    let mut maplayers = String::new();
    for (k, layer) in layers.iter().enumerate() {
        let id = format!("layer_{k}_{}", layer.name.replace(|c: char| !c.is_ascii_alphanumeric(), "_"));
        let (name, path) = (escape(&layer.name), escape(&layer.path));
        let provider = if layer.is_vector { "ogr" } else { "gdal" };
        let checked =
            if layer.is_vector || Some(layer.name.as_str()) == shown { "Qt::Checked" } else { "Qt::Unchecked" };
        let _ = writeln!(
            tree,
            "    <layer-tree-layer id=\"{id}\" name=\"{name}\" source=\"./{path}\" providerKey=\"{provider}\" \
             checked=\"{checked}\" expanded=\"0\"/>"
        );
        let _ = writeln!(order, "    <layer id=\"{id}\"/>");
        let kind = if layer.is_vector { "vector" } else { "raster" };
        let symbols = legend.layers.iter().find(|l| !layer.is_vector && l.layer.name() == layer.name).map(pipe);
        let _ = write!(
            maplayers,
            "    <maplayer type=\"{kind}\" autoRefreshEnabled=\"0\">\n      <id>{id}</id>\n      \
             <datasource>./{path}</datasource>\n      <layername>{name}</layername>\n      \
             <provider>{provider}</provider>\n{}    </maplayer>\n",
            symbols.unwrap_or_default()
        );
    }
    let (u0, v1) = (legend.u_min_m, legend.v_max_m);
    let (u1, v0) = (u0 + legend.width_px as f64 * legend.cell_m, v1 - legend.height_px as f64 * legend.cell_m);
    format!(
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n\
         <qgis projectname=\"{0}\" version=\"3.22.0\">\n  <title>{0}</title>\n  \
         <layer-tree-group>\n{tree}  </layer-tree-group>\n  \
         <mapcanvas name=\"theMapCanvas\">\n    <units>meters</units>\n    <extent>\n      <xmin>{u0}</xmin>\n      \
         <ymin>{v0}</ymin>\n      <xmax>{u1}</xmax>\n      <ymax>{v1}</ymax>\n    </extent>\n  </mapcanvas>\n  \
         <projectlayers>\n{maplayers}  </projectlayers>\n  <layerorder>\n{order}  </layerorder>\n  \
         <properties>\n    <Paths>\n      <Absolute type=\"bool\">false</Absolute>\n    </Paths>\n  </properties>\n</qgis>\n",
        escape(title)
    )
}

/// How a raster is drawn.
fn pipe(layer: &LegendLayer) -> String {
    let renderer = match &layer.look {
        Look::Rgba => "      <rasterrenderer type=\"multibandcolor\" redBand=\"1\" greenBand=\"2\" blueBand=\"3\" \
                       alphaBand=\"4\" opacity=\"1\"/>\n"
            .to_owned(),
        Look::Grey { low, high } => format!(
            "      <rasterrenderer type=\"singlebandgray\" grayBand=\"1\" alphaBand=\"-1\" opacity=\"1\" \
             gradient=\"BlackToWhite\">\n        <contrastEnhancement>\n          <minValue>{low}</minValue>\n          \
             <maxValue>{high}</maxValue>\n          <algorithm>StretchToMinimumMaximum</algorithm>\n        \
             </contrastEnhancement>\n      </rasterrenderer>\n"
        ),
        Look::Labels(classes) => palette(classes.iter().map(|c| (f64::from(c.value), c.color, c.name.clone()))),
        Look::Coverage => {
            palette(layer.swatches.iter().enumerate().map(|(k, s)| (k as f64 + 1.0, s.color, s.label.clone())))
        }
        Look::Ramp { low, high, .. } => ramp(layer, *low, *high),
        Look::Stretch { high, .. } => ramp(layer, 1.0, *high),
        Look::None => return String::new(),
    };
    format!("    <pipe>\n{renderer}    </pipe>\n")
}

fn palette(entries: impl Iterator<Item = (f64, [u8; 3], String)>) -> String {
    let mut text = String::from(
        "      <rasterrenderer type=\"paletted\" band=\"1\" alphaBand=\"-1\" opacity=\"1\">\n        <colorPalette>\n",
    );
    for (value, color, label) in entries {
        let _ = writeln!(
            text,
            "          <paletteEntry value=\"{value}\" color=\"{}\" label=\"{}\" alpha=\"255\"/>",
            hex(color),
            escape(&label)
        );
    }
    text + "        </colorPalette>\n      </rasterrenderer>\n"
}

fn ramp(layer: &LegendLayer, low: f64, high: f64) -> String {
    let mut text = format!(
        "      <rasterrenderer type=\"singlebandpseudocolor\" band=\"1\" alphaBand=\"-1\" opacity=\"1\" \
         classificationMin=\"{low}\" classificationMax=\"{high}\">\n        <rastershader>\n          \
         <colorrampshader colorRampType=\"INTERPOLATED\" classificationMode=\"1\" clip=\"0\">\n"
    );
    let steps = layer.swatches.len().max(2) - 1;
    for (k, swatch) in layer.swatches.iter().enumerate() {
        let value = low + (high - low) * k as f64 / steps as f64;
        let _ = writeln!(
            text,
            "            <item value=\"{value}\" color=\"{}\" label=\"{}\" alpha=\"255\"/>",
            hex(swatch.color),
            escape(&swatch.label)
        );
    }
    text + "          </colorrampshader>\n        </rastershader>\n      </rasterrenderer>\n"
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Layer, NoData, Ramp, Swatch};

    fn entry(layer: Layer, look: Look, swatches: Vec<Swatch>) -> LegendLayer {
        LegendLayer {
            layer,
            meaning: "m".into(),
            unit: "m".into(),
            bands: vec!["a".into()],
            band_offsets: vec![],
            no_data: NoData::Nan,
            look,
            swatches,
        }
    }

    #[test]
    fn a_project_names_every_layer_by_a_relative_path() {
        let swatches = vec![
            Swatch { label: "-1 m".into(), color: [0, 0, 255] },
            Swatch { label: "1 m".into(), color: [255, 0, 0] },
        ];
        let legend = Legend {
            view: String::new(),
            cell_m: 0.01,
            u_min_m: 0.0,
            v_max_m: 5.0,
            width_px: 2000,
            height_px: 1000,
            layers: vec![
                entry(Layer::Color, Look::Rgba, vec![]),
                entry(Layer::Offset, Look::Ramp { ramp: Ramp::Diverging, low: -1.0, high: 1.0 }, swatches),
                entry(Layer::Xyz, Look::None, vec![]),
            ],
        };
        let lines = ProjectLayer { name: "traces".into(), path: "vectors/traces.gpkg".into(), is_vector: true };
        let text = project("A & B", &legend, &[lines]);
        for path in ["./map/color.tif", "./map/offset.tif", "./map/xyz.tif", "./vectors/traces.gpkg"] {
            assert_eq!(text.matches(&format!("<datasource>{path}</datasource>")).count(), 1, "{path}");
        }
        assert!(text.contains("A &amp; B") && text.contains("<xmax>20</xmax>") && text.contains("<ymin>-5</ymin>"));
        // Every element is closed.
        for name in ["qgis", "maplayer", "layer-tree-group", "pipe", "rasterrenderer", "projectlayers"] {
            let opened = text.matches(&format!("<{name} ")).count() + text.matches(&format!("<{name}>")).count();
            let closed = text.matches(&format!("</{name}>")).count();
            let at_once = if name == "rasterrenderer" { 1 } else { 0 };
            assert_eq!(opened, closed + at_once, "{name}");
        }
        let style = style(&legend.layers[1]);
        assert!(style.contains("value=\"-1\" color=\"#0000ff\"") && style.contains("value=\"1\" color=\"#ff0000\""));
    }
}
