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
}

/// Detects separator, header and columns from the beginning of a text.
pub(super) fn detect(head: &[u8], wanted: Option<&[String]>) -> Result<Layout, String> {
    let mut lines: Vec<&[u8]> = head.split_inclusive(|&b| b == b'\n').collect();
    // The last line may be cut off by the window.
    if lines.len() > 1 && !head.ends_with(b"\n") {
        lines.pop();
    }
    let first_data = lines
        .iter()
        .position(|l| !is_void(l) && separators(l).is_some_and(|line| numeric(&line, l)))
        .ok_or("no line of at least three numbers was found at its beginning")?;
    let header = &lines[..first_data];
    let line = separators(lines[first_data]).expect("the line was found by its separators");
    let sample: Vec<Vec<f64>> = lines[first_data..]
        .iter()
        .filter(|l| !is_void(l))
        .take(1000)
        .filter_map(|l| line.words(l.trim_ascii()).map(|w| parse(&line, w)).collect::<Option<Vec<f64>>>())
        .filter(|row| row.len() >= line.columns)
        .collect();
    let promised =
        header.iter().find(|l| !is_void(l)).and_then(|l| std::str::from_utf8(l.trim_ascii()).ok()?.parse::<u64>().ok());
    let mut layout = Layout {
        line,
        names: Vec::new(),
        header_lines: first_data as u64,
        header_bytes: header.iter().map(|l| l.len() as u64).sum(),
        origin: "values",
        promised,
    };
    if let Some(wanted) = wanted {
        if wanted.len() > line.columns {
            return Err(format!("{} columns are set, but its lines have {}", wanted.len(), line.columns));
        }
        layout.names = wanted.iter().map(|n| if n == "skip" { String::new() } else { n.clone() }).collect();
        layout.line.columns = wanted.len();
        layout.origin = "settings";
    } else if let Some(names) = header.iter().rev().find_map(|l| header_names(l, &line)) {
        layout.names = names;
        layout.origin = "header line";
    } else {
        layout.names = guess(&sample, line.columns);
    }
    Ok(layout)
}

/// The separator of a line of numbers.
fn separators(line: &[u8]) -> Option<Line> {
    let line = line.trim_ascii();
    let has = |b: u8| line.contains(&b);
    let separator = if has(b';') {
        b';'
    } else if has(b'\t') {
        b'\t'
    } else if has(b',') {
        b','
    } else {
        b' '
    };
    let decimal_comma = separator == b';' && has(b',');
    let mut found = Line { separator, decimal_comma, columns: 0 };
    // Tabs between blank-padded words read as blanks.
    if separator == b'\t' && found.words(line).any(|w| w.contains(&b' ')) {
        found.separator = b' ';
    }
    found.columns = found.words(line).count();
    // A trailing separator makes an empty last column.
    while found.columns > 0 && found.words(line).nth(found.columns - 1).is_some_and(<[u8]>::is_empty) {
        found.columns -= 1;
    }
    (found.columns >= 3).then_some(found)
}

fn parse(line: &Line, word: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(word).ok()?.trim_matches('"');
    if line.decimal_comma { text.replace(',', ".").parse().ok() } else { text.parse().ok() }
}

fn numeric(line: &Line, text: &[u8]) -> bool {
    line.words(text.trim_ascii()).take(line.columns).all(|w| w.is_empty() || parse(line, w).is_some())
        && line.words(text.trim_ascii()).take(3).all(|w| !w.is_empty())
}

/// Names of a header line such as `//X Y Z R G B` or `x;y;z;Intensity`, if it names all coordinates.
fn header_names(text: &[u8], line: &Line) -> Option<Vec<String>> {
    let text = text.trim_ascii();
    let text = text.strip_prefix(b"//").or_else(|| text.strip_prefix(b"#")).unwrap_or(text);
    let own = separators(text).map_or(*line, |l| l);
    let mut names: Vec<String> = own.words(text).map(|w| canonical(&String::from_utf8_lossy(w))).collect();
    names.truncate(line.columns);
    names.resize(line.columns, String::new());
    ["x", "y", "z"].iter().all(|c| names.iter().any(|n| n == c)).then_some(names)
}

/// The name without quotes, units and the many spellings of coordinates.
fn canonical(name: &str) -> String {
    let name = name.trim().trim_matches('"');
    let bare = name.split(['[', '(']).next().unwrap_or(name).trim().to_ascii_lowercase();
    match bare.as_str() {
        "x" | "easting" | "east" | "e" | "x_m" | "coordx" => "x".into(),
        "y" | "northing" | "north" | "n" | "y_m" | "coordy" => "y".into(),
        "z" | "elevation" | "height" | "altitude" | "h" | "z_m" | "coordz" => "z".into(),
        "r" | "rf" => "red".into(),
        "g" | "gf" => "green".into(),
        "b" | "bf" => "blue".into(),
        "i" => "intensity".into(),
        _ => name.to_owned(),
    }
}

/// Columns without names: coordinates first, then what the values look like.
fn guess(sample: &[Vec<f64>], columns: usize) -> Vec<String> {
    let whole = |column: usize, most: f64| {
        sample.iter().all(|row| row.get(column).is_some_and(|v| v.fract() == 0.0 && (0.0..=most).contains(v)))
    };
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
    fn text_without_numbers_is_refused() {
        assert!(detect(b"hello world\nthis is text\n", None).is_err());
    }
}
