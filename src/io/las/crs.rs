//! The coordinate reference system of a LAS file, as text and as far as Adit must understand it.
//!
//! Adit does not transform coordinates; it must only know whether they are lengths, and in which unit.

use super::super::crs::{Crs, from_wkt};
use super::header::{Container, f64_at, u16_at};

const PROJECTION: &str = "LASF_Projection";
const GEO_KEYS: u16 = 34735;
const GEO_DOUBLES: u16 = 34736;
const GEO_ASCII: u16 = 34737;
const WKT: u16 = 2112;

/// What the file says about its coordinate system; WKT wins over GeoTIFF keys.
pub(super) fn of(container: &Container) -> Option<Crs> {
    if let Some(record) = container.vlr(PROJECTION, WKT) {
        let end = record.data.iter().position(|&b| b == 0).unwrap_or(record.data.len());
        let wkt = String::from_utf8_lossy(&record.data[..end]).trim().to_owned();
        if !wkt.is_empty() {
            return Some(from_wkt(&wkt));
        }
    }
    let keys = &container.vlr(PROJECTION, GEO_KEYS)?.data;
    let empty = Vec::new();
    let doubles = container.vlr(PROJECTION, GEO_DOUBLES).map_or(&empty, |v| &v.data);
    let ascii = container.vlr(PROJECTION, GEO_ASCII).map_or(&empty, |v| &v.data);
    from_geo_keys(keys, doubles, ascii)
}

fn from_geo_keys(keys: &[u8], doubles: &[u8], ascii: &[u8]) -> Option<Crs> {
    const MODEL: u16 = 1024;
    const GEOGRAPHIC: u16 = 2048;
    const PROJECTED: u16 = 3072;
    const LINEAR_UNIT: u16 = 3076;
    const LINEAR_UNIT_SIZE: u16 = 3077;
    const CITATIONS: [u16; 3] = [1026, 2049, 3073];
    if keys.len() < 8 {
        return None;
    }
    let mut model = None;
    let mut codes = Vec::new();
    let mut citations = Vec::new();
    let mut unit = None;
    for key in keys[8..].chunks_exact(8).take(usize::from(u16_at(keys, 6))) {
        let [id, place, count, value] = [0, 2, 4, 6].map(|at| u16_at(key, at));
        match (id, place) {
            (MODEL, 0) => model = Some(value),
            (GEOGRAPHIC | PROJECTED, 0) if value != 0 && value != 32767 => codes.push((id, value)),
            (LINEAR_UNIT, 0) => {
                unit = match value {
                    9001 => Some(1.0),
                    9002 => Some(0.3048),
                    9003 => Some(1200.0 / 3937.0),
                    _ => unit,
                };
            }
            (LINEAR_UNIT_SIZE, GEO_DOUBLES) if usize::from(value) * 8 + 8 <= doubles.len() => {
                unit = Some(f64_at(doubles, usize::from(value) * 8));
            }
            (_, GEO_ASCII) if CITATIONS.contains(&id) => {
                let (from, to) = (usize::from(value), usize::from(value) + usize::from(count));
                if let Some(text) = ascii.get(from..to.min(ascii.len())) {
                    let text = super::header::text(text);
                    let text = text.trim_end_matches('|').trim();
                    if !text.is_empty() {
                        citations.push(text.to_owned());
                    }
                }
            }
            _ => {}
        }
    }
    if model.is_none() && codes.is_empty() && citations.is_empty() {
        return None;
    }
    codes.sort_by_key(|c| std::cmp::Reverse(c.0));
    let mut text: Vec<String> = codes.iter().take(1).map(|(_, code)| format!("EPSG:{code}")).collect();
    text.extend(citations);
    let text = if text.is_empty() { "GeoTIFF keys without a code".to_owned() } else { text.join(", ") };
    Some(Crs {
        text,
        degrees: model == Some(2) || (model.is_none() && codes.first().is_some_and(|c| c.0 == GEOGRAPHIC)),
        metres_per_unit: unit.filter(|u| u.is_finite() && *u > 0.0),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(entries: &[[u16; 4]]) -> Vec<u8> {
        let mut all = vec![1, 1, 0, entries.len() as u16];
        all.extend(entries.iter().flatten());
        all.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    #[test]
    fn projected_feet() {
        let crs = from_geo_keys(&keys(&[[1024, 0, 1, 1], [3072, 0, 1, 2994], [3076, 0, 1, 9002]]), &[], &[]).unwrap();
        assert_eq!(crs, Crs { text: "EPSG:2994".into(), degrees: false, metres_per_unit: Some(0.3048) });
    }

    #[test]
    fn geographic_is_in_degrees() {
        let crs = from_geo_keys(&keys(&[[1024, 0, 1, 2], [2048, 0, 1, 4326]]), &[], &[]).unwrap();
        assert!(crs.degrees);
    }

    #[test]
    fn citation_out_of_range_is_ignored() {
        assert_eq!(from_geo_keys(&keys(&[[1026, GEO_ASCII, 500, 40]]), &[], b"short|"), None);
    }
}
