//! Software prefetch of packed weights while a product is made: one line after the other, or as several
//! streams.
//!
//! Some CPUs read DRAM faster as several streams than as one: one thread of a Sapphire Rapids 18.7 instead of
//! 11.6 GB/s. Others do not: two threads of a Zen 4 read 35 GB/s either way (medians of five runs). Bits do
//! not depend on it.

use std::ops::Range;

use super::Block;
use crate::simd::LINE;

/// Words of a stream: a page, because the CPU's own prefetching follows one stream in each.
const STREAM: usize = 1024;

/// Streams of a stretch of weights at most. A whole panel of 6144 inputs overflows the second-level cache
/// before it is used.
const MAX_STREAMS: usize = 48;

impl Block<'_> {
    /// Whether weights are prefetched as streams, where a step meets `step_words` of them.
    #[inline(always)]
    pub(super) fn prefetches_streams(&self, step_words: usize) -> bool {
        // Streams whose steps are one line would ask for each line once a tile. In order, AVX2 was 0.99 to
        // 1.17 times as fast on an Intel with AMX (float32, bfloat16 widened and int8), AVX-512 with its
        // three lines 0.70 to 1.01 times.
        self.streams && step_words > LINE
    }
}

/// The panel that a block goes through, in parts: all calls of the micro-kernel take one part, then all the
/// next.
pub(super) struct Parts<'a> {
    block: &'a Block<'a>,
    /// Words that a step meets, and the steps of the panel and of a part.
    step_words: usize,
    steps: usize,
    part_steps: usize,
    /// [`Block::prefetches_streams`].
    streams: bool,
}

impl<'a> Parts<'a> {
    /// Parts of `part_steps`, but for the last one.
    #[inline(always)]
    pub(super) fn new(block: &'a Block<'a>, step_words: usize, steps: usize, part_steps: usize) -> Self {
        Self {
            block,
            step_words,
            steps,
            part_steps,
            streams: block.prefetches_streams(step_words),
        }
    }

    /// The steps of each, in order.
    #[inline(always)]
    pub(super) fn iter(&self) -> impl Iterator<Item = Range<usize>> {
        let count = self.steps.div_ceil(self.part_steps).max(1);
        (0..count).map(|index| self.part_of(index * self.part_steps))
    }

    /// The steps of the part that has step number `step`.
    #[inline(always)]
    pub(super) fn part_of(&self, step: usize) -> Range<usize> {
        let start = step / self.part_steps * self.part_steps;
        start..self.steps.min(start + self.part_steps)
    }

    /// The weights that this thread takes after `part`: where they begin, and how many words they are.
    #[inline(always)]
    fn after(&self, part: &Range<usize>) -> (*const u32, usize) {
        let weights = self.block.weights;
        if part.end < self.steps {
            let steps = self.part_steps.min(self.steps - part.end);
            let at = weights.as_ptr().wrapping_add(part.end * self.step_words);
            return (at, steps * self.step_words);
        }
        let at = weights.as_ptr().wrapping_add(self.block.ahead * weights.len());
        (at, self.part_steps.min(self.steps) * self.step_words)
    }

    /// What call number `call` of the micro-kernel prefetches in the steps of `part`, one line in a step.
    #[inline(always)]
    pub(super) fn lines(&self, part: &Range<usize>, call: usize) -> Lines {
        let calls = self.block.calls.len();
        if !self.streams {
            // The call's share of the next panel, spread over its steps.
            let weights = self.block.weights;
            let (share, pitch) = (weights.len() * call / calls, self.step_words.div_ceil(calls));
            let next = self.block.ahead * weights.len() + share + part.start * pitch;
            return Lines {
                first: weights.as_ptr().wrapping_add(next),
                pitch,
                round: part.len().max(1),
                advance: 0,
            };
        }
        let (at, words) = self.after(part);
        let streams = (words / STREAM).clamp(1, MAX_STREAMS);
        let pitch = words.div_ceil(streams).next_multiple_of(LINE);
        // Each call takes its share of all streams, a line of each in a round.
        Lines {
            first: at.wrapping_add(pitch * call / calls),
            pitch,
            round: streams,
            advance: (pitch * streams).div_ceil(calls * part.len().max(1)),
        }
    }
}

impl Parts<'_> {
    /// The same where steps are long: several lines in each of them.
    pub(super) fn bursts(&self, part: &Range<usize>, call: usize) -> Bursts {
        let calls = self.block.calls.len();
        if !self.streams {
            let Lines { first, pitch, .. } = self.lines(part, call);
            return Bursts {
                first,
                lines: pitch.div_ceil(LINE),
                pitch: LINE,
                advance: pitch,
            };
        }
        let (at, words) = self.after(part);
        // A line of each stream in a step.
        let pitch = LINE * part.len();
        let streams = words.div_ceil(pitch).min(2 * MAX_STREAMS);
        let first = streams * call / calls;
        Bursts {
            first: at.wrapping_add(first * pitch),
            lines: streams * (call + 1) / calls - first,
            pitch,
            advance: LINE,
        }
    }
}

/// Lines to prefetch in each step, `pitch` words apart, and in the next step from `advance` words further on.
#[derive(Clone, Copy)]
pub(super) struct Bursts {
    pub first: *const u32,
    pub lines: usize,
    pub pitch: usize,
    pub advance: usize,
}

/// Lines to prefetch, one in a step: `pitch` words apart for `round` steps, then again from `advance` words
/// further.
#[derive(Clone, Copy)]
pub(super) struct Lines {
    pub first: *const u32,
    pub pitch: usize,
    pub round: usize,
    pub advance: usize,
}

impl Lines {
    /// Where the line of step number `step` of the part is, and how many steps are left of its round, this
    /// one included.
    #[inline(always)]
    pub(super) fn at(&self, step: usize) -> (*const u32, usize) {
        let (round, within) = (step / self.round, step % self.round);
        let at = round * self.advance + within * self.pitch;
        (self.first.wrapping_add(at), self.round - within)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::super::{RowSplit, Shape};
    use super::*;
    use crate::rows::Rows;

    /// The lines of the weights that a block prefetches, as numbers from the panel's first one on.
    fn asked(
        [rows, mr]: [usize; 2],
        [steps, step_words, part_steps]: [usize; 3],
        streams: bool,
        lines_of: impl Fn(&Parts<'_>, &Range<usize>, usize) -> Vec<*const u32>,
    ) -> HashSet<isize> {
        let shape = Shape {
            nr: step_words,
            mr,
            row_group: 1,
        };
        let split = RowSplit::new(rows, shape);
        let weights = vec![0; steps * step_words];
        let block = Block {
            x: Rows::new(&[], 0),
            in_features: steps,
            split,
            calls: 0..split.count,
            weights: &weights,
            needed: step_words,
            ahead: 2,
            streams,
            out: std::ptr::null(),
            out_stride: 0,
        };
        let parts = Parts::new(&block, step_words, steps, part_steps);
        let mut asked = HashSet::new();
        for part in parts.iter() {
            for call in 0..split.count {
                let lines = lines_of(&parts, &part, call);
                let words = |line: *const u32| (line.addr() as isize - weights.as_ptr().addr() as isize) / 4;
                asked.extend(
                    lines
                        .into_iter()
                        .map(|line| words(line).div_euclid(LINE as isize)),
                );
            }
        }
        asked
    }

    /// One line in a step; more where there are fewer tiles than lines in a step, as the tiles of vectors do.
    fn of_lines(parts: &Parts<'_>, part: &Range<usize>, call: usize) -> Vec<*const u32> {
        let lines = parts.lines(part, call);
        let more = (parts.step_words / LINE).div_ceil(parts.block.calls.len());
        let of_step = |step| {
            let (at, left) = lines.at(step);
            assert!((1..=lines.round).contains(&left));
            (0..more).map(move |line| at.wrapping_add(line * LINE))
        };
        (0..part.len()).flat_map(of_step).collect()
    }

    fn of_bursts(parts: &Parts<'_>, part: &Range<usize>, call: usize) -> Vec<*const u32> {
        let Bursts {
            first,
            lines,
            pitch,
            advance,
        } = parts.bursts(part, call);
        let of_step =
            |step: usize| (0..lines).map(move |line| first.wrapping_add(step * advance + line * pitch));
        (0..part.len()).flat_map(of_step).collect()
    }

    /// As streams or in order, nearly all of what follows is asked for, and little else.
    #[test]
    #[cfg_attr(miri, ignore = "takes minutes, and has no unsafe code to check")]
    fn what_comes_next_is_asked_for() {
        for (rows, sizes @ [steps, step_words, part_steps], bursts) in [
            ([49, 7], [1536, 48, 1024], false),
            ([49, 7], [6144, 48, 1024], false),
            ([5, 7], [2048, 48, 1024], false),
            ([49, 6], [1536, 16, 1024], false),
            ([90, 8], [2048, 48, 1024], false),
            ([49, 32], [48, 768, 48], true),
            ([49, 32], [192, 768, 64], true),
            ([296, 32], [100, 768, 56], true),
            ([7, 32], [24, 768, 24], true),
        ] {
            let panel = (steps * step_words / LINE) as isize;
            for streams in [false, true] {
                let what = format!("{rows:?} rows, {sizes:?}, streams {streams}");
                let asked = match bursts {
                    false => asked(rows, sizes, streams, of_lines),
                    true => asked(rows, sizes, streams, of_bursts),
                };
                // In order: the panel that this thread takes next. As streams: the parts after the first, and
                // the first of that panel.
                let first = (part_steps * step_words / LINE) as isize;
                let wanted: HashSet<isize> = match streams && step_words > LINE {
                    false => (2 * panel..3 * panel).collect(),
                    true => (first..panel).chain(2 * panel..2 * panel + first).collect(),
                };
                let found = wanted.intersection(&asked).count();
                assert!(
                    found * 100 >= wanted.len() * 97,
                    "{what}: {found} of {}",
                    wanted.len()
                );
                let beyond = asked.difference(&wanted).count();
                assert!(
                    beyond * 8 <= wanted.len(),
                    "{what}: {beyond} beyond {}",
                    wanted.len()
                );
            }
        }
    }
}
