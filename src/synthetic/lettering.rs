//! Letters painted on a wall, in a 5 x 7 bitmap font, so that a mirrored or turned map is seen at once.

/// Columns of a letter, and of the gap to the next one.
const COLUMNS: usize = 5;
const GAP: usize = 1;
/// Rows of a letter.
const ROWS: usize = 7;

/// Which wall the text stands on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wall {
    /// Left when facing increasing chainage (negative girth).
    Left,
    /// Right when facing increasing chainage (positive girth).
    Right,
}

/// A line of text painted on a wall, upright and readable for somebody who stands in the tunnel and faces that wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Lettering {
    /// Capital letters, digits, `+`, `-`, `.` and spaces; anything else is painted as a filled box.
    pub text: String,
    /// The wall.
    pub wall: Wall,
    /// Chainage of the middle of the text, metres.
    pub chainage_m: f64,
    /// Girth from the crown to the middle of the text, metres (positive on both walls).
    pub girth_m: f64,
    /// Height of the letters, metres.
    pub height_m: f64,
    /// Colour of the paint: red, green, blue from 0 to 1.
    pub paint: [f64; 3],
}

impl Lettering {
    /// Side of one dot of the font, metres.
    pub fn dot_m(&self) -> f64 {
        self.height_m / ROWS as f64
    }

    /// Length of the text along the tunnel, metres.
    pub fn width_m(&self) -> f64 {
        let count = self.text.chars().count();
        (count * (COLUMNS + GAP) - GAP.min(count)) as f64 * self.dot_m()
    }

    /// Whether there is paint at (chainage, girth).
    pub fn covers(&self, chainage: f64, girth: f64) -> bool {
        // Who faces the left wall has increasing chainage on the right hand; who faces the right wall, on the left.
        let across = match self.wall {
            Wall::Left if girth < 0.0 => chainage - self.chainage_m,
            Wall::Right if girth > 0.0 => self.chainage_m - chainage,
            _ => return false,
        };
        // Up on a wall is towards the crown.
        let down = girth.abs() - self.girth_m + self.height_m / 2.0;
        let column = ((across + self.width_m() / 2.0) / self.dot_m()).floor();
        let row = (down / self.dot_m()).floor();
        if column < 0.0 || row < 0.0 || row >= ROWS as f64 {
            return false;
        }
        let (letter, column) = (column as usize / (COLUMNS + GAP), column as usize % (COLUMNS + GAP));
        match self.text.chars().nth(letter) {
            Some(c) if column < COLUMNS => glyph(c)[row as usize] & (1 << (COLUMNS - 1 - column)) != 0,
            _ => false,
        }
    }
}

/// Rows from top to bottom; bit 4 is the left column.
fn glyph(c: char) -> [u8; ROWS] {
    match c {
        ' ' => [0; ROWS],
        'A' => [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'B' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10001, 0b10001, 0b11110],
        'C' => [0b01111, 0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b01111],
        'D' => [0b11110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b11110],
        'E' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b11111],
        'F' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b10000],
        'G' => [0b01111, 0b10000, 0b10000, 0b10011, 0b10001, 0b10001, 0b01111],
        'H' => [0b10001, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'I' => [0b01110, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        'J' => [0b00111, 0b00010, 0b00010, 0b00010, 0b00010, 0b10010, 0b01100],
        'K' => [0b10001, 0b10010, 0b10100, 0b11000, 0b10100, 0b10010, 0b10001],
        'L' => [0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b11111],
        'M' => [0b10001, 0b11011, 0b10101, 0b10101, 0b10001, 0b10001, 0b10001],
        'N' => [0b10001, 0b11001, 0b11101, 0b10101, 0b10111, 0b10011, 0b10001],
        'O' => [0b01110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'P' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10000, 0b10000, 0b10000],
        'Q' => [0b01110, 0b10001, 0b10001, 0b10001, 0b10101, 0b10010, 0b01101],
        'R' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10100, 0b10010, 0b10001],
        'S' => [0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110],
        'T' => [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100],
        'U' => [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'V' => [0b10001, 0b10001, 0b10001, 0b10001, 0b01010, 0b01010, 0b00100],
        'W' => [0b10001, 0b10001, 0b10001, 0b10101, 0b10101, 0b11011, 0b10001],
        'X' => [0b10001, 0b10001, 0b01010, 0b00100, 0b01010, 0b10001, 0b10001],
        'Y' => [0b10001, 0b10001, 0b01010, 0b00100, 0b00100, 0b00100, 0b00100],
        'Z' => [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b10000, 0b11111],
        '0' => [0b01110, 0b10011, 0b10011, 0b10101, 0b11001, 0b11001, 0b01110],
        '1' => [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        '2' => [0b01110, 0b10001, 0b00001, 0b00110, 0b01000, 0b10000, 0b11111],
        '3' => [0b11110, 0b00001, 0b00001, 0b01110, 0b00001, 0b00001, 0b11110],
        '4' => [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
        '5' => [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
        '6' => [0b00110, 0b01000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
        '7' => [0b11111, 0b00001, 0b00010, 0b00100, 0b00100, 0b01000, 0b01000],
        '8' => [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
        '9' => [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00010, 0b01100],
        '+' => [0b00000, 0b00100, 0b00100, 0b11111, 0b00100, 0b00100, 0b00000],
        '-' => [0b00000, 0b00000, 0b00000, 0b11111, 0b00000, 0b00000, 0b00000],
        '.' => [0b00000, 0b00000, 0b00000, 0b00000, 0b00000, 0b01100, 0b01100],
        _ => [0b11111; ROWS],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn letter(wall: Wall) -> Lettering {
        Lettering { text: "L".into(), wall, chainage_m: 10.0, girth_m: 3.0, height_m: 0.7, paint: [1.0; 3] }
    }

    #[test]
    fn an_l_has_its_foot_down_and_to_the_readers_right() {
        // Dots are 10 cm; the stem is the reader's left column, the foot the lowest row.
        let left = letter(Wall::Left);
        assert!(left.covers(9.8, -2.7) && left.covers(9.8, -3.3), "stem at smaller chainage");
        assert!(left.covers(10.2, -3.3) && !left.covers(10.2, -2.7), "foot at larger chainage, away from the crown");
        let right = letter(Wall::Right);
        assert!(right.covers(10.2, 2.7) && right.covers(10.2, 3.3), "stem at larger chainage");
        assert!(right.covers(9.8, 3.3) && !right.covers(9.8, 2.7), "foot at smaller chainage");
    }

    #[test]
    fn paint_stays_on_its_wall_and_in_its_box() {
        let left = letter(Wall::Left);
        assert!((left.width_m() - 0.5).abs() < 1e-12);
        for (s, g) in [(9.8, 3.0), (9.74, -3.0), (10.26, -3.34), (9.8, -2.64), (9.8, -3.36), (10.9, -3.0)] {
            assert!(!left.covers(s, g), "{s} {g}");
        }
    }

    #[test]
    fn every_glyph_is_different() {
        let mut seen: Vec<[u8; ROWS]> = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789+-. ".chars().map(glyph).collect();
        let count = seen.len();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), count);
    }
}
