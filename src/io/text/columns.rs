//! What the columns of a text scan mean: from its header line, the settings, or the values of its first lines.

use super::lines::{Line, is_void};

/// Detected layout of a text.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layout {
    pub(super) line: Line,
    /// Names of the columns; those that mean nothing here are empty.
    pub(super) names: Vec<String>,
    /// Lines before the first one with numbers.
    pub(super) header_lines: u64,
    /// Bytes of these lines.
    pub(super) header_bytes: u64,
    /// How the columns became known, for people.
    pub(super) origin: &'static str,
    /// The number of points that the first line promises (PTS).
    pub(super) promised: Option<u64>,
    /// Whether numbers are written with a decimal comma.
    pub(super) decimal_comma: bool,
    /// Whether the header calls the coordinates longitude and latitude.
    pub(super) degrees: bool,
    /// Lines before the first point that are no comment, no header and no count: how many, and the first of them.
    pub(super) skipped: Option<(usize, String)>,
}

/// What a header line says.
struct Header {
    names: Vec<String>,
    degrees: bool,
}

/// Detects separator, header and columns from the beginning of a text.
pub(super) fn detect(head: &[u8], wanted: Option<&[String]>) -> Result<Layout, String> {
    let mut lines: Vec<&[u8]> = head.split_inclusive(|&b| b == b'\n').collect();
    // The last line may be cut off by the window.
    if lines.len() > 1 && !head.ends_with(b"\n") {
        lines.pop();
    }
    const NO_NUMBERS: &str = "no line of at least three numbers was found at its beginning";
    let header = lines.iter().enumerate().find_map(|(at, line)| Some((at, header_of(line)?)));
    let coordinates = |names: &[String]| -> Vec<usize> {
        ["x", "y", "z"].iter().filter_map(|c| names.iter().position(|n| n == c)).collect()
    };
    let (first_data, line, mut names, origin) = if let Some(wanted) = wanted {
        let names: Vec<String> = wanted.iter().map(|n| if n == "skip" { String::new() } else { n.clone() }).collect();
        let needed: Vec<usize> = (0..names.len()).filter(|&i| !names[i].is_empty()).collect();
        let found = first_line(&lines, 0, Some(&needed)).filter(|(_, line)| line.columns >= wanted.len());
        let (at, line) = found.ok_or_else(|| match first_line(&lines, 0, None) {
            Some((_, line)) => format!("{} columns are set, but its lines have {}", wanted.len(), line.columns),
            None => NO_NUMBERS.to_owned(),
        })?;
        (at, Line { columns: wanted.len(), ..line }, names, "settings")
    } else if let Some((at, header)) = &header {
        let (at, line) = first_line(&lines, at + 1, Some(&coordinates(&header.names)))
            .ok_or("its header names the coordinates, but no line with numbers in these columns follows")?;
        // The last columns of the first line may be empty; what is not named at the end may be missing anywhere.
        let there = line.words(lines[at].trim_ascii()).count();
        (at, Line { columns: there.min(header.names.len()), ..line }, header.names.clone(), "header line")
    } else {
        let (at, line) = first_line(&lines, 0, None).ok_or(NO_NUMBERS)?;
        let sample = lines[at..].iter().filter(|l| !is_void(l)).take(1000);
        let rows = sample.map(|l| line.words(l.trim_ascii()).map(|w| line.number(w)).collect());
        (at, line, guess(&rows.collect::<Vec<_>>(), line.columns), "values")
    };
    names.resize(line.columns, String::new());
    let before = &lines[..first_data];
    let promised = before.iter().find(|l| !is_void(l)).and_then(|l| count_of(l));
    let is_known = |l: &[u8]| is_void(l) || header_of(l).is_some() || count_of(l).is_some();
    let skipped: Vec<&[u8]> = before.iter().copied().filter(|l| !is_known(l)).collect();
    Ok(Layout {
        decimal_comma: line.decimal_comma && lines[first_data..].iter().take(1000).any(|l| l.contains(&b',')),
        line,
        names,
        header_lines: first_data as u64,
        header_bytes: before.iter().map(|l| l.len() as u64).sum(),
        origin,
        promised,
        degrees: origin == "header line" && header.is_some_and(|(_, h)| h.degrees),
        skipped: skipped.first().map(|l| (skipped.len(), super::lines::shorten(l.trim_ascii()))),
    })
}

/// The number that stands alone in a line.
fn count_of(line: &[u8]) -> Option<u64> {
    std::str::from_utf8(line.trim_ascii()).ok()?.parse().ok()
}

/// The first line from `from` on with numbers: in the `needed` columns, or everywhere and at least three.
fn first_line(lines: &[&[u8]], from: usize, needed: Option<&[usize]>) -> Option<(usize, Line)> {
    let understood = |text: &[u8]| separations(text).find(|line| numeric(line, text, needed));
    (from..lines.len()).filter(|&at| !is_void(lines[at])).find_map(|at| Some((at, understood(lines[at])?)))
}

/// The ways in which a line may be separated, the most telling separator first; those that make at least three columns.
fn separations(text: &[u8]) -> impl Iterator<Item = Line> {
    let text = text.trim_ascii();
    let separators = [b';', b'\t', b',', b'|', b' '].into_iter().filter(move |s| *s == b' ' || text.contains(s));
    separators.filter_map(move |separator| {
        let mut line = Line { separator, decimal_comma: separator != b',', columns: 0 };
        let words: Vec<&[u8]> = line.words(text).collect();
        // A trailing separator makes empty columns at the end.
        line.columns = words.iter().rposition(|w| !w.is_empty()).map_or(0, |last| last + 1);
        (line.columns >= 3).then_some(line)
    })
}

fn numeric(line: &Line, text: &[u8], needed: Option<&[usize]>) -> bool {
    let words: Vec<&[u8]> = line.words(text.trim_ascii()).take(line.columns).collect();
    match needed {
        Some(needed) => needed.iter().all(|&c| words.get(c).is_some_and(|w| line.number(w).is_some())),
        None => {
            words.iter().all(|w| w.is_empty() || line.number(w).is_some()) && words[..3].iter().all(|w| !w.is_empty())
        }
    }
}

/// What a line such as `//X Y Z R G B` or `x;y;z;Intensity` says, if it names all coordinates.
fn header_of(text: &[u8]) -> Option<Header> {
    let text = text.trim_ascii();
    let text = text.strip_prefix(b"//").or_else(|| text.strip_prefix(b"#")).unwrap_or(text);
    separations(text).find_map(|line| {
        let words = line.words(text).take(line.columns);
        let mut names: Vec<String> = words.map(|w| canonical(&String::from_utf8_lossy(w))).collect();
        let place = |wanted: &str| names.iter().position(|n| n == wanted);
        let degrees = match (place("x"), place("y"), place("z")) {
            (Some(_), Some(_), Some(_)) => false,
            (None, None, Some(_)) => {
                let angle =
                    |wanted: &[&str]| wanted.iter().find_map(|w| names.iter().position(|n| n.eq_ignore_ascii_case(w)));
                let (east, north) = (angle(&["lon", "long", "lng", "longitude"])?, angle(&["lat", "latitude"])?);
                (names[east], names[north]) = ("x".to_owned(), "y".to_owned());
                true
            }
            _ => return None,
        };
        Some(Header { names, degrees })
    })
}

/// The name without quotes, units and the many spellings of coordinates.
fn canonical(name: &str) -> String {
    let name = name.trim().trim_matches('"');
    let bare = name.split(['[', '(']).next().unwrap_or(name).trim().to_ascii_lowercase();
    match bare.as_str() {
        "x" | "easting" | "east" | "e" | "x_m" | "coordx" => "x".into(),
        "y" | "northing" | "north" | "n" | "y_m" | "coordy" => "y".into(),
        "z" | "elevation" | "height" | "altitude" | "alt" | "h" | "z_m" | "coordz" => "z".into(),
        "r" | "rf" => "red".into(),
        "g" | "gf" => "green".into(),
        "b" | "bf" => "blue".into(),
        "i" => "intensity".into(),
        _ => name.to_owned(),
    }
}

/// Columns without names: coordinates first, then what the values look like.
fn guess(rows: &[Vec<Option<f64>>], columns: usize) -> Vec<String> {
    let is_whole = |v: f64, most: f64| v.fract() == 0.0 && (0.0..=most).contains(&v);
    // Lines that do not fit are refused later, with their number.
    let rows = || rows.iter().filter(|row| row.len() >= columns && row[..columns].iter().all(Option::is_some));
    let whole = |column: usize, most: f64| rows().all(|row| row[column].is_some_and(|v| is_whole(v, most)));
    let color_at = |at: usize| at + 3 <= columns && (at..at + 3).all(|c| whole(c, 255.0));
    let mut names: Vec<&str> = vec!["x", "y", "z"];
    match columns {
        4 | 5 => names.push("intensity"),
        6 if color_at(3) => names.extend(["red", "green", "blue"]),
        7.. if color_at(4) && !(color_at(3) && !whole(6, 255.0)) => names.extend(["intensity", "red", "green", "blue"]),
        7.. if color_at(3) => names.extend(["red", "green", "blue", "intensity"]),
        _ => {}
    }
    let mut names: Vec<String> = names.into_iter().map(str::to_owned).collect();
    names.resize(columns, String::new());
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(text: &str) -> Vec<String> {
        detect(text.as_bytes(), None).unwrap().names
    }

    #[test]
    fn header_lines_name_the_columns() {
        assert_eq!(
            names("//X Y Z R G B Scalar_Label\n1 2 3 4 5 6 7\n"),
            ["x", "y", "z", "red", "green", "blue", "Scalar_Label"]
        );
        assert_eq!(names("Easting [m];Northing [m];Height;I\n1,5;2,5;3,5;7\n"), ["x", "y", "z", "intensity"]);
        assert_eq!(names("id,x,y,z\n1,2,3,4\n"), ["id", "x", "y", "z"]);
    }

    #[test]
    fn values_name_the_columns() {
        assert_eq!(names("1.5 2 3\n"), ["x", "y", "z"]);
        assert_eq!(names("1.5 2 3 0.7 10 20 30\n"), ["x", "y", "z", "intensity", "red", "green", "blue"]);
        assert_eq!(names("1.5 2 3 10 20 30 0.7\n"), ["x", "y", "z", "red", "green", "blue", "intensity"]);
        assert_eq!(names("1.5 2 3 0.1 0.2 0.3\n"), ["x", "y", "z", "", "", ""]);
    }

    #[test]
    fn the_first_line_of_a_pts_is_its_count() {
        let layout = detect(b"2\n1 2 3 -1500 10 20 30\n1 2 3 -1500 10 20 30\n", None).unwrap();
        assert_eq!((layout.promised, layout.header_lines, layout.header_bytes), (Some(2), 1, 2));
        assert_eq!(layout.names[3], "intensity");
    }

    #[test]
    fn decimal_commas() {
        let layout = detect(b"1,5;2,5;3,5\n", None).unwrap();
        assert!(layout.line.decimal_comma && layout.line.columns == 3);
    }

    #[test]
    fn decimal_commas_between_blanks_and_tabs() {
        for text in ["1,5 2,5 3,5\n", "1,5\t2,5\t3,5\n", "1,5|2,5|3,5\n"] {
            let layout = detect(text.as_bytes(), None).unwrap();
            assert!(layout.decimal_comma && layout.line.columns == 3, "{text}");
            assert_eq!(layout.line.number(b"1,5"), Some(1.5));
        }
        let layout = detect(b"1.5, 2.5, 3.5\n", None).unwrap();
        assert!(!layout.decimal_comma && layout.line.columns == 3);
        assert_eq!(layout.line.number(b"1,5"), None);
    }

    #[test]
    fn named_coordinates_may_stand_beside_text() {
        let layout = detect(b"name,x,y,z,date\np1,1,2,3,2024-01-01 10:00\np2,4,5,6,\n", None).unwrap();
        assert_eq!((layout.names.len(), layout.header_lines, layout.line.columns), (5, 1, 5));
        let wanted = ["skip", "x", "y", "z"].map(str::to_owned);
        assert_eq!(detect(b"p1 1 2 3\np2 4 5 6\n", Some(&wanted)).unwrap().line.columns, 4);
    }

    #[test]
    fn longitude_and_latitude_are_degrees() {
        let layout = detect(b"lat,lon,alt\n46.1,7.1,500\n", None).unwrap();
        assert!(layout.degrees);
        assert_eq!(layout.names, ["y", "x", "z"]);
        assert!(!detect(b"x,y,z,lat,lon\n1,2,3,46,7\n", None).unwrap().degrees);
    }

    #[test]
    fn a_first_line_that_is_no_header_is_told() {
        let layout = detect(b"1.234,5;2;3\n4;5;6\n", None).unwrap();
        assert_eq!(layout.skipped, Some((1, "1.234,5;2;3".to_owned())));
        assert_eq!(detect(b"# c\n2\nx y z\n4 5 6\n", None).unwrap().skipped, None);
    }

    #[test]
    fn text_without_numbers_is_refused() {
        assert!(detect(b"hello world\nthis is text\n", None).is_err());
    }
}
