use super::*;
use crate::map::{Layer, Look, NoData};
use std::convert::Infallible;

fn legend(length_m: f64) -> Legend {
    let layer = LegendLayer {
        layer: Layer::Color,
        meaning: "colour".into(),
        unit: String::new(),
        bands: vec![],
        band_offsets: vec![],
        no_data: NoData::Alpha,
        look: Look::Rgba,
        swatches: vec![],
    };
    Legend {
        view: String::new(),
        cell_m: 0.01,
        u_min_m: -0.2,
        v_max_m: 6.0,
        width_px: (length_m * 100.0) as usize,
        height_px: 1300,
        layers: vec![layer],
    }
}

fn settings() -> SheetSettings {
    SheetSettings { scale: 100.0, paper_mm: None, layout: Layout::ChainageX, view: View::Inside, dpi: 50.0 }
}

/// The upper right quarter of the whole map is red, the rest blue.
fn quarter(legend: &Legend) -> impl FnMut(Vec2, Vec2, usize, usize) -> Result<Picture, Infallible> {
    let middle = legend.u_min_m + legend.width_px as f64 * 0.005;
    move |low, high, width, height| {
        let rgba = (0..width * height)
            .flat_map(|i| {
                let u = low.x + ((i % width) as f64 + 0.5) / width as f64 * (high.x - low.x);
                let v = high.y - ((i / width) as f64 + 0.5) / height as f64 * (high.y - low.y);
                if u > middle && v > 0.0 { [255, 0, 0, 255] } else { [0, 0, 255, 255] }
            })
            .collect();
        Ok(Picture { width, height, rgba })
    }
}

fn draw(length_m: f64, settings: &SheetSettings) -> Vec<Page> {
    let legend = legend(length_m);
    let line = ReferenceLine { kind: LineKind::Crown, pieces: vec![vec![[0.0, 0.0], [length_m, 0.0]]] };
    let trace = Trace { id: "F7".into(), points: vec![[2.0, -3.0], [9.0, 4.0]] };
    let strip = Strip {
        name: "azimuth".into(),
        unit: "deg".into(),
        values: (0..100).map(|i| [f64::from(i), 60.0 + f64::from(i) / 10.0]).collect(),
        range: [60.0, 70.0],
        color: [0; 3],
    };
    let content = SheetContent {
        legend: &legend,
        layer: &legend.layers[0],
        lines: &[line],
        traces: &[trace],
        strips: &[strip],
        title: &[("project".into(), "test".into())],
    };
    sheet(&content, settings, &mut quarter(&legend)).unwrap()
}

fn texts(page: &Page) -> Vec<(String, [f64; 2])> {
    let text = |i: &Item| match i {
        Item::Text { text, at, .. } => Some((text.clone(), *at)),
        _ => None,
    };
    page.items.iter().filter_map(text).collect()
}

#[test]
fn ten_metres_are_a_hundred_millimetres() {
    for layout in [Layout::ChainageX, Layout::ChainageY] {
        let pages = draw(22.0, &SheetSettings { layout, ..settings() });
        let texts = texts(&pages[0]);
        let find = |wanted: &str| texts.iter().find(|t| t.0 == wanted).unwrap().1;
        let (a, b) = (find("0+000"), find("0+010"));
        let along = if layout == Layout::ChainageX { b[0] - a[0] } else { a[1] - b[1] };
        assert!((along - 100.0).abs() < 1e-9, "{layout:?}: {along}");
        let image = pages[0].items.iter().find_map(|i| match i {
            Item::Image { width_mm, height_mm, .. } => Some((*width_mm, *height_mm)),
            _ => None,
        });
        let (w, h) = image.unwrap();
        let girth = if layout == Layout::ChainageX { h } else { w };
        assert!((girth - 130.0).abs() < 1e-9);
    }
}

#[test]
fn long_tunnels_get_pages_that_overlap() {
    let pages = draw(141.0, &SheetSettings { paper_mm: Some([420.0, 297.0]), ..settings() });
    assert_eq!(pages.len(), 5);
    // Every page shows what its neighbour ends with.
    let labels = |k: usize| texts(&pages[k]).iter().map(|t| t.0.clone()).collect::<Vec<_>>();
    assert!(labels(0).contains(&"0+030".to_owned()) && labels(1).contains(&"0+040".to_owned()));
    assert!(labels(0).iter().any(|t| t.contains("page 1 of 5")) && labels(4).iter().any(|t| t.contains("0+140.8")));
}

#[test]
fn views_and_layouts_put_the_right_wall_where_they_say() {
    // Where the red quarter (right wall, far end) is: share of the picture's width and height.
    let red = |layout, view| {
        let pages = draw(20.0, &SheetSettings { layout, view, ..settings() });
        let picture = pages[0].items.iter().find_map(|i| match i {
            Item::Image { picture, .. } => Some(picture.clone()),
            _ => None,
        });
        let picture = picture.unwrap();
        let red: Vec<usize> = (0..picture.width * picture.height).filter(|&i| picture.rgba[4 * i] == 255).collect();
        let mean = |f: &dyn Fn(usize) -> f64| red.iter().map(|&i| f(i)).sum::<f64>() / red.len() as f64;
        let (x, y) = (mean(&|i| (i % picture.width) as f64), mean(&|i| (i / picture.width) as f64));
        (x > picture.width as f64 / 2.0, y > picture.height as f64 / 2.0)
    };
    // (right half, lower half)
    assert_eq!(red(Layout::ChainageX, View::Inside), (true, false));
    assert_eq!(red(Layout::ChainageX, View::Outside), (true, true));
    assert_eq!(red(Layout::ChainageY, View::Inside), (false, false));
    assert_eq!(red(Layout::ChainageY, View::Outside), (true, false));
    let outside = draw(20.0, &SheetSettings { view: View::Outside, ..settings() });
    let texts = texts(&outside[0]);
    assert!(texts.iter().any(|t| t.0.contains("mirror image")));
    let y = |wanted: &str| texts.iter().find(|t| t.0 == wanted).unwrap().1[1];
    assert!(y("L") < y("R"));
}

#[test]
fn what_does_not_fit_is_refused_with_a_scale_that_does() {
    let legend = legend(20.0);
    let content =
        SheetContent { legend: &legend, layer: &legend.layers[0], lines: &[], traces: &[], strips: &[], title: &[] };
    let small = SheetSettings { paper_mm: Some([297.0, 210.0]), scale: 50.0, ..settings() };
    let error = sheet(&content, &small, &mut quarter(&legend)).unwrap_err();
    assert!(error.to_string().contains("1:100 or smaller"), "{error}");
    let nonsense = SheetSettings { scale: 0.0, ..settings() };
    assert!(matches!(sheet(&content, &nonsense, &mut quarter(&legend)), Err(SheetError::Scale { .. })));
}
