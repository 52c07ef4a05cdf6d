//! Which records of a file gave no point.

/// Ascending runs of record numbers (zero-based). Long runs take no more room than short ones.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DroppedRecords {
    runs: Vec<Run>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Run {
    first: u64,
    count: u64,
    /// Records in the runs before.
    before: u64,
}

impl DroppedRecords {
    /// Adds `count` records from `first` on, which must lie behind all that are there.
    pub fn push(&mut self, first: u64, count: u64) {
        if count == 0 {
            return;
        }
        let before = self.count();
        match self.runs.last_mut() {
            Some(last) if last.first + last.count == first => last.count += count,
            last => {
                debug_assert!(last.is_none_or(|l| l.first + l.count < first), "records come in their order");
                self.runs.push(Run { first, count, before });
            }
        }
    }

    /// How many there are.
    pub fn count(&self) -> u64 {
        self.runs.last().map_or(0, |last| last.before + last.count)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// The first of them.
    pub fn first(&self) -> Option<u64> {
        self.runs.first().map(|run| run.first)
    }

    /// Number of the record that gave the `point`-th point of its file.
    pub fn record_of(&self, point: u64) -> u64 {
        // A run lies before the point when that many records before the run gave points.
        let runs = self.runs.partition_point(|run| run.first - run.before <= point);
        point + runs.checked_sub(1).map_or(0, |last| self.runs[last].before + self.runs[last].count)
    }

    /// Number among the points of its file of the point that a record gave; `None` when it gave none.
    pub fn point_of(&self, record: u64) -> Option<u64> {
        let runs = self.runs.partition_point(|run| run.first <= record);
        let Some(last) = runs.checked_sub(1).map(|last| self.runs[last]) else { return Some(record) };
        (record - last.first >= last.count).then(|| record - last.before - last.count)
    }

    /// The same records and those of the points that are not kept; `keep` has one entry for each point.
    pub fn and_points(&self, keep: &[bool]) -> Self {
        let mut all = Self::default();
        let mut point = 0;
        let points = keep.len() as u64;
        let mut points_before = |end: u64, all: &mut Self| {
            while point < end {
                if !keep[point as usize] {
                    all.push(self.record_of(point), 1);
                }
                point += 1;
            }
        };
        for run in &self.runs {
            points_before((run.first - run.before).min(points), &mut all);
            all.push(run.first, run.count);
        }
        points_before(points, &mut all);
        all
    }
}

impl FromIterator<u64> for DroppedRecords {
    /// From ascending record numbers.
    fn from_iter<I: IntoIterator<Item = u64>>(records: I) -> Self {
        let mut dropped = Self::default();
        records.into_iter().for_each(|record| dropped.push(record, 1));
        dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_and_points_count_each_other() {
        let gone = [0u64, 2, 3, 9, 10, 11, 15];
        let dropped: DroppedRecords = gone.into_iter().collect();
        assert_eq!((dropped.count(), dropped.first(), dropped.runs.len()), (7, Some(0), 4));
        let there: Vec<u64> = (0..20).filter(|r| !gone.contains(r)).collect();
        for record in 0..20 {
            let point = there.iter().position(|r| *r == record).map(|p| p as u64);
            assert_eq!(dropped.point_of(record), point, "{record}");
        }
        for (point, record) in there.iter().enumerate() {
            assert_eq!(dropped.record_of(point as u64), *record);
        }
    }

    #[test]
    fn points_that_are_not_kept_are_dropped_as_well() {
        let dropped: DroppedRecords = [0u64, 2, 3, 6].into_iter().collect();
        // The points are records 1, 4, 5 and 7.
        let all = dropped.and_points(&[true, false, true, false]);
        assert_eq!(all, [0u64, 2, 3, 4, 6, 7].into_iter().collect());
        assert_eq!(DroppedRecords::default().and_points(&[false, true, false]), [0u64, 2].into_iter().collect());
    }
}
