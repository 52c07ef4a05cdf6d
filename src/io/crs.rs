//! What a file says about its coordinate reference system, as far as a map in metres depends on it.

/// A coordinate reference system as stated by a file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Crs {
    /// The statement: WKT, or code and citation of GeoTIFF keys.
    pub(super) text: String,
    /// Whether horizontal coordinates are angles.
    pub(super) degrees: bool,
    /// Metres in a horizontal unit, when stated.
    pub(super) metres_per_unit: Option<f64>,
}

/// Understands the kind and the horizontal unit of WKT 1 and 2.
pub(super) fn from_wkt(wkt: &str) -> Crs {
    let upper = wkt.to_ascii_uppercase();
    let projected = ["PROJCS[", "PROJCRS[", "PROJECTEDCRS["].iter().find_map(|k| upper.find(k));
    let geographic = ["GEOGCS[", "GEOGCRS[", "GEOGRAPHICCRS[", "GEODCRS["].iter().any(|k| upper.contains(k));
    let local = ["LOCAL_CS[", "ENGCRS[", "ENGINEERINGCRS["].iter().find_map(|k| upper.find(k));
    let metres_per_unit = projected.or(local).and_then(|at| unit_of(&upper[at..]));
    Crs { text: wkt.to_owned(), degrees: projected.is_none() && geographic, metres_per_unit }
}

/// The length unit of the first element of a WKT text: in WKT 2 that of its axes, in WKT 1 its own `UNIT`.
fn unit_of(wkt: &str) -> Option<f64> {
    if let Some(axes) = wkt.find("CS[CARTESIAN") {
        let axes = &wkt[axes..];
        return factor_of(&axes[axes.find("LENGTHUNIT[")?..]);
    }
    let mut depth = 0;
    let mut quoted = false;
    for (at, c) in wkt.char_indices() {
        match c {
            '"' => quoted = !quoted,
            '[' if !quoted => {
                depth += 1;
                if depth == 2 && wkt[..at].ends_with(",UNIT") {
                    return factor_of(&wkt[at..]);
                }
            }
            ']' if !quoted => {
                depth -= 1;
                if depth == 0 {
                    return None;
                }
            }
            _ => {}
        }
    }
    None
}

/// The factor in `UNIT["name",factor...`.
fn factor_of(unit: &str) -> Option<f64> {
    let factor = unit.split(']').next()?.split(',').nth(1)?;
    factor.trim().parse().ok().filter(|f: &f64| f.is_finite() && *f > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const UTM: &str = r#"COMPD_CS["x",PROJCS["UTM 15N",GEOGCS["WGS 84",DATUM["D",SPHEROID["S",6378137,298.2]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["a",0],UNIT["US survey foot",0.304800609601219]],VERT_CS["h",UNIT["metre",1]]]"#;

    #[test]
    fn unit_is_the_projected_one() {
        let crs = from_wkt(UTM);
        assert!(!crs.degrees);
        assert_eq!(crs.metres_per_unit, Some(0.304800609601219));
    }

    #[test]
    fn geographic_wkt_is_in_degrees() {
        let crs = from_wkt(r#"GEOGCS["WGS 84",DATUM["D",SPHEROID["S",6378137,298.2]],UNIT["degree",0.017]]"#);
        assert!(crs.degrees);
        assert_eq!(crs.metres_per_unit, None);
    }

    #[test]
    fn wkt2_length_unit() {
        let crs = from_wkt(
            r#"PROJCRS["x",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["e",6378137,298.2]]],CONVERSION["c"],CS[Cartesian,2],AXIS["e",east,LENGTHUNIT["foot",0.3048]]]"#,
        );
        assert_eq!(crs.metres_per_unit, Some(0.3048));
        assert!(!crs.degrees);
    }
}
