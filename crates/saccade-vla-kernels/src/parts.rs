//! Splitting rows, tiles or panels evenly into the tasks of a parallel loop.

use std::ops::Range;

use crate::pool::parallel_for;
use crate::rows::{RowsMut, SharedRows};

/// Elements from which a second thread pays: below, one core is done in less time than it takes to wake
/// another.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Elements of one task: long enough that dealing it costs nothing, short enough that threads finish
/// together.
const ELEMENTS_PER_TASK: usize = 1 << 13;

/// Runs `work` on parts of the rows of `out`, on as many threads as pay; with each part, the numbers of its
/// rows.
pub(crate) fn parallel_rows<T: Send>(
    threads: usize,
    out: RowsMut<'_, T>,
    work: impl Fn(Range<usize>, RowsMut<'_, T>) + Sync,
) {
    let (rows, width) = (out.num_rows(), out.num_columns());
    let (threads, tasks) = threads_and_tasks(threads, rows, width, rows);
    let out = SharedRows::new(out);
    parallel_for(threads, tasks, &|task| {
        let rows = part(rows, task, tasks);
        // SAFETY: each task runs once, and parts do not overlap.
        let part = unsafe { out.block(rows.clone(), 0..width) };
        work(rows, part);
    });
}

/// The number of threads, at most `threads`, and of tasks, at most `most_tasks`, for `rows` rows of `width`
/// elements.
pub(crate) fn threads_and_tasks(
    threads: usize,
    rows: usize,
    width: usize,
    most_tasks: usize,
) -> (usize, usize) {
    // A number of elements beyond the address space is many, whatever it is.
    let elements = rows.saturating_mul(width);
    let threads = if elements < ELEMENTS_FOR_THREADS {
        1
    } else {
        threads
    };
    (threads, elements.div_ceil(ELEMENTS_PER_TASK).min(most_tasks))
}

/// The part of `count` that task number `index` of `parts` has. The parts differ by one at most, and none
/// overlaps another: tasks that write them rely on it, so no product here may wrap.
#[inline(always)]
pub(crate) fn part(count: usize, index: usize, parts: usize) -> Range<usize> {
    part_start(count, index, parts)..part_start(count, index + 1, parts)
}

/// The beginning of part number `index` of `parts`: `count * index / parts`.
#[inline(always)]
pub(crate) fn part_start(count: usize, index: usize, parts: usize) -> usize {
    match count.checked_mul(index) {
        Some(product) => product / parts,
        None => wide_part_start(count, index, parts),
    }
}

/// The same where the product needs more than a word.
#[cold]
fn wide_part_start(count: usize, index: usize, parts: usize) -> usize {
    (count as u128 * index as u128 / parts as u128) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_is_in_one_part() {
        // Miri is slow: it gets little more than what goes to several threads.
        let (few, many) = if cfg!(miri) { (67, 1000) } else { (100, 4096) };
        assert_eq!(threads_and_tasks(3, few, many, few).0, 3);
        for (rows, width) in [(0, 3), (5, 0), (1, 1), (7, 3), (few, many), (many, few)] {
            let mut data = vec![0; rows * width];
            parallel_rows(
                3,
                RowsMut::strided(&mut data, rows, width, width),
                |rows, mut out| {
                    assert_eq!((out.num_rows(), out.num_columns()), (rows.len(), width));
                    for (index, row) in rows.enumerate() {
                        out.row_mut(index)
                            .iter_mut()
                            .for_each(|element| *element += 1 + row);
                    }
                },
            );
            assert!(
                (0..rows * width).all(|at| data[at] == 1 + at / width),
                "{rows} x {width}"
            );
        }
    }

    #[test]
    fn tasks_of_more_elements_than_memory_has_are_counted() {
        assert_eq!(threads_and_tasks(4, usize::MAX, usize::MAX, 1000), (4, 1000));
        assert_eq!(threads_and_tasks(4, 3, 5, 3), (1, 1));
        assert_eq!(threads_and_tasks(4, 0, 5, 0), (1, 0));
        assert_eq!(threads_and_tasks(4, 8, 1 << 14, 8), (4, 8));
    }

    #[test]
    fn parts_follow_each_other_and_differ_by_one_at_most() {
        const LARGEST: usize = usize::MAX / 2;
        for (count, parts) in [
            (49, 7),
            (5, 8),
            (0, 3),
            (LARGEST, 3),
            (LARGEST, 1 << (usize::BITS * 5 / 8)),
            (LARGEST, LARGEST),
        ] {
            assert_eq!(
                (part_start(count, 0, parts), part_start(count, parts, parts)),
                (0, count)
            );
            for index in [0, 1, parts / 2, parts - 2, parts - 1] {
                let (this, next) = (part(count, index, parts), part_start(count, index + 1, parts));
                assert_eq!(this.end, next);
                assert!(
                    [count / parts, count.div_ceil(parts)].contains(&this.len()),
                    "part {index} of {count} in {parts}: {this:?}"
                );
            }
        }
    }
}
