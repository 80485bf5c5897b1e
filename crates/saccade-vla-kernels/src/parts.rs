//! Parts of a number of rows, tiles or panels, dealt evenly: which part has which of them, whatever the sizes.

use std::ops::Range;

/// Those of `count` that part number `index` of `parts` has. The parts differ by one at most, and none overlaps another: tasks that write
/// them rely on it, so no product here may wrap.
#[inline(always)]
pub(crate) fn part(count: usize, index: usize, parts: usize) -> Range<usize> {
    part_start(count, index, parts)..part_start(count, index + 1, parts)
}

/// Where part number `index` of `parts` begins: `count * index / parts`.
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
    fn parts_follow_each_other_and_differ_by_one_at_most() {
        const LARGEST: usize = usize::MAX / 2;
        for (count, parts) in [
            (49, 7),
            (5, 8),
            (0, 3),
            (LARGEST, 3),
            (LARGEST, 1 << 40),
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
