//! Handles given by a person who wants to steer a deformation: a place in the scan and where it shall lie on the map.
//!
//! They come as CSV with the columns `x, y, z, u, v`: position in scan coordinates, chainage and girth from the crown in
//! metres. Separators are comma, semicolon, tab or blanks; with a header line the columns may have any order
//! (`x`/`easting`, `y`/`northing`, `z`/`elevation`/`height`, `u`/`chainage`/`chainage_m`, `v`/`girth`/`girth_m`; others are
//! ignored). Lines that start with `#` and empty lines are skipped.
//!
//! Each handle is brought to the nearest point of the surface. How far it wants to be from where the section chart has
//! that point is interpolated over the whole chart, biharmonically: one handle shifts the map, two shift and shear it,
//! more bend it. The automatic handles and bones aim at their places plus this displacement.

use super::Error;
use super::cage::{Cage, Sample};
use super::guide::Guide;
use crate::cloud::ScanFrame;
use crate::cut::Strip;
use crate::mesh::nearest_face::FaceTree;
use crate::numeric::{Vec2, Vec3, sparse};

/// Handles farther from the surface than this share of the mean girth are refused: 0.5 m in a tunnel of 25 m girth.
const FARTHEST_OF_GIRTH: f64 = 0.02;

/// A place in the scan that shall lie at a place of the map.
#[derive(Clone, Debug, PartialEq)]
pub struct Handle {
    /// Where it was given, for messages: file and line.
    pub given_in: String,
    /// Position in local metres.
    pub position_in_local: Vec3,
    /// Chainage and girth, metres.
    pub place_in_chart: Vec2,
}

const COLUMNS: [&[&str]; 5] = [
    &["x", "easting", "east", "e", "x_m"],
    &["y", "northing", "north", "n", "y_m"],
    &["z", "elevation", "height", "h", "z_m"],
    &["u", "chainage", "chainage_m", "u_m"],
    &["v", "girth", "girth_m", "v_m"],
];

/// Reads handles from the text of the CSV file `name`; `frame` is the frame of the scan.
///
/// # Errors
/// [`Error::Handles`] names the file and the line.
pub fn import_csv(text: &str, name: &str, frame: &ScanFrame) -> Result<Vec<Handle>, Error> {
    let mut columns: Option<[usize; 5]> = None;
    let mut handles = Vec::new();
    for (number, raw) in text.lines().enumerate() {
        let given_in = format!("{name}:{}", number + 1);
        let content = raw.trim_start_matches('\u{feff}').trim();
        if content.is_empty() || content.starts_with('#') {
            continue;
        }
        let fields = fields(content);
        let places = match columns {
            Some(places) => places,
            None if fields.iter().any(|f| f.parse::<f64>().is_err()) => {
                columns = Some(header(&fields, given_in)?);
                continue;
            }
            None if fields.len() == 5 => *columns.insert([0, 1, 2, 3, 4]),
            None => {
                let problem = format!("expected x, y, z, u, v (or a header line), found {} columns", fields.len());
                return Err(Error::Handles { given_in, problem });
            }
        };
        let mut numbers = [0.0; 5];
        for ((number, &column), names) in numbers.iter_mut().zip(&places).zip(COLUMNS) {
            let field = fields.get(column).copied().unwrap_or("");
            *number = field.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| Error::Handles {
                given_in: given_in.clone(),
                problem: format!("{} (column {}) should be a number, found '{field}'", names[0], column + 1),
            })?;
        }
        let [x, y, z, u, v] = numbers;
        handles.push(Handle {
            given_in,
            position_in_local: frame.local_from_scan(&Vec3::new(x, y, z)),
            place_in_chart: Vec2::new(u, v),
        });
    }
    if handles.is_empty() {
        let given_in = format!("{name}:{}", text.lines().count());
        return Err(Error::Handles { given_in, problem: "the file ends without a handle".to_owned() });
    }
    Ok(handles)
}

fn fields(line: &str) -> Vec<&str> {
    match [';', '\t', ','].into_iter().find(|s| line.contains(*s)) {
        Some(s) => line.split(s).map(|f| f.trim().trim_matches('"')).collect(),
        None => line.split_whitespace().collect(),
    }
}

fn header(fields: &[&str], given_in: String) -> Result<[usize; 5], Error> {
    let mut places = [0; 5];
    for (place, accepted) in places.iter_mut().zip(COLUMNS) {
        let named = |f: &&str| accepted.contains(&f.to_lowercase().as_str());
        *place = fields.iter().position(named).ok_or_else(|| Error::Handles {
            given_in: given_in.clone(),
            problem: format!("the header has no column '{}'; it has: {}", accepted[0], fields.join(", ")),
        })?;
    }
    Ok(places)
}

/// What the given handles ask of a strip.
pub(super) struct Steering {
    /// How far each vertex should be from its place in the section chart.
    pub displacement: Vec<Vec2>,
    /// For each handle the vertex next to it and where that vertex should be on the map.
    pub held: Vec<(u32, Vec2)>,
}

impl Steering {
    /// Ties the guide's handles to the surface and spreads their displacement; none without handles.
    ///
    /// # Errors
    /// [`Error::Handles`] for a handle far from the surface or two at one vertex, [`Error::Solve`].
    pub fn of(strip: &Strip, guide: &Guide, method: &'static str) -> Result<Option<Self>, Error> {
        if guide.handles().is_empty() {
            return Ok(None);
        }
        let mesh = strip.mesh();
        let tree = FaceTree::of(mesh);
        let reach = FARTHEST_OF_GIRTH * guide.summary().section.mean_girth_m;
        let mut samples = Vec::new();
        let mut held: Vec<(u32, Vec2)> = Vec::new();
        for handle in guide.handles() {
            let nearest = tree.nearest(mesh, &handle.position_in_local, reach, None).ok_or_else(|| Error::Handles {
                given_in: handle.given_in.clone(),
                problem: format!("the handle is more than {reach:.2} m from the surface"),
            })?;
            let corners = mesh.faces()[nearest.face as usize];
            let weights = nearest.barycentric;
            let foot: Vec2 = corners.iter().zip(weights).map(|(&v, w)| guide.uv()[v as usize] * w).sum();
            let displacement = handle.place_in_chart - foot;
            let nearest_corner = (0..3).max_by(|&a, &b| weights[a].total_cmp(&weights[b])).expect("three corners");
            let vertex = corners[nearest_corner];
            if let Some(other) = held.iter().position(|(v, _)| *v == vertex) {
                let problem =
                    format!("the handle is at the same vertex as that of {}", guide.handles()[other].given_in);
                return Err(Error::Handles { given_in: handle.given_in.clone(), problem });
            }
            held.push((vertex, guide.uv()[vertex as usize] + displacement));
            samples.push(Sample { place: foot, weight: 1.0, value: displacement });
        }
        let solve_error = |e: sparse::Error| Error::Solve { method, what: e.to_string() };
        let cage = Cage::over(mesh.faces().iter().flatten().map(|&v| guide.uv()[v as usize])).map_err(solve_error)?;
        let field = cage.interpolating_field(samples.into_iter()).map_err(solve_error)?;
        let displacement = guide.uv().iter().map(|p| cage.at(&field, *p)).collect();
        Ok(Some(Self { displacement, held }))
    }

    /// Root mean square distance of the handles' vertices from where they should be, metres.
    pub fn missed_by_m(&self, uv: &[Vec2]) -> f64 {
        let sum: f64 = self.held.iter().map(|(v, place)| (uv[*v as usize] - place).norm_squared()).sum();
        (sum / self.held.len() as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(text: &str) -> String {
        import_csv(text, "h.csv", &ScanFrame::local()).unwrap_err().to_string()
    }

    #[test]
    fn columns_may_come_by_name_in_any_order() {
        let frame = ScanFrame::with_origin(Vec3::new(1000.0, 2000.0, 0.0));
        let by_name = "# corners\ngirth_m; chainage_m; easting; northing; height\n-2.5; 12; 1001; 2002; 3\n";
        let by_place = "1001 2002 3 12 -2.5";
        for (text, given_in) in [(by_name, "h.csv:3"), (by_place, "h.csv:1")] {
            let expected = Handle {
                given_in: given_in.to_owned(),
                position_in_local: Vec3::new(1.0, 2.0, 3.0),
                place_in_chart: Vec2::new(12.0, -2.5),
            };
            assert_eq!(import_csv(text, "h.csv", &frame).unwrap(), [expected]);
        }
    }

    #[test]
    fn errors_name_the_line() {
        let text = problem("x,y,z,u,v\n1,2,3,4,5\n\n1,2,nan,4,5\n");
        assert!(text.contains("h.csv:4") && text.contains("z (column 3)") && text.contains("'nan'"), "{text}");
        let text = problem("x,y,z,chainage\n1,2,3,4\n");
        assert!(text.contains("h.csv:1") && text.contains("no column 'v'"), "{text}");
        assert!(problem("1,2,3\n").contains("h.csv:1"));
        assert!(problem("x,y,z,u,v\n").contains("without a handle"));
        assert!(problem("1,2,3,4,5\n1,2,3,4\n").contains("h.csv:2"));
    }
}
