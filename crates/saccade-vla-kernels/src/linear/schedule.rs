//! The schedule of a layer: the order in which blocks of rows pass its panels, so that weights come from
//! memory once however many rows there are.
//!
//! All rows in one block would need no schedule, but their activations would not stay in a core's cache. One
//! block after the other through all panels reads weights that are larger than the caches once a block: 17
//! times for 32 observations of 49 rows. Panels are therefore taken in groups that the shared cache holds.
//! All blocks pass a group before the next group begins, so its panels come from memory with the first block
//! only, and activations are read once a group.
//!
//! Bytes from memory where the shared cache holds a group but not the layer, bf16, 1568 rows, 2 threads: 1536
//! x 6144 reads 43 MB (326 MB block by block), 6144 x 1536 reads 96 MB (340 MB). The multiply-adds take 6 ms
//! at the peak of two Sapphire Rapids cores with AMX, in which they can read 160 MB.
//!
//! Threads that take turns have lanes of panels: the first takes them from the front of a group on, the
//! second from its middle. Panels next to each other are never written at the same time, since a core that
//! asks for a cache line of results also asks for its neighbour, which the other core is writing. The weights
//! of a thread follow each other, too. `sample` of N1.5 takes 0.88 (int8) and 0.94 (bfloat16) of the time
//! with panels dealt by turns (Intel with AMX, 2 threads; float32 0.98; not measured on AMD).

/// Bytes of the panels of a group: less than a few cores' part of the shared cache (2 to 4 MB a core on
/// servers), and several times the activations of a block.
const GROUP_BYTES: usize = 4 << 20;

/// Tasks of a call: each a block of rows through a panel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Schedule {
    blocks: usize,
    panels: usize,
    groups: usize,
    /// Lanes of a group.
    threads: usize,
}

impl Schedule {
    /// `blocks` of rows through `panels` of `panel_bytes` on `threads`, each of which has at least
    /// `per_thread` panels of a group.
    pub(super) fn new(
        blocks: usize,
        panels: usize,
        panel_bytes: usize,
        threads: usize,
        per_thread: usize,
    ) -> Self {
        let in_group = (GROUP_BYTES / panel_bytes.max(1)).max(per_thread * threads);
        Self {
            blocks,
            panels,
            // One block meets each panel once. `at` multiplies the two numbers without checks.
            groups: match blocks {
                1 => 1,
                _ => panels.div_ceil(in_group).min(usize::MAX / panels.max(1)),
            },
            threads,
        }
    }

    pub(super) fn tasks(&self) -> usize {
        // Each writes a result of its own, so there are no more than memory has.
        self.blocks * self.panels
    }

    /// The block and the panel of task number `task`. Within a group, blocks outside and panels inside:
    /// threads then share a block of activations.
    pub(super) fn at(&self, task: usize) -> (usize, usize) {
        let Self {
            blocks,
            panels,
            groups,
            threads,
        } = *self;
        // Groups before this one have `blocks` tasks for each of their panels.
        let group = ((task / blocks + 1) * groups - 1) / panels;
        let (first, end) = (panels * group / groups, panels * (group + 1) / groups);
        let count = end - first;
        let within = task - blocks * first;
        let (block, turn) = (within / count, within % count);
        let (lane, step) = (turn % threads, turn / threads);
        // The first lanes have one panel more, where they are not equal.
        let lane_first = count / threads * lane + lane.min(count % threads);
        (block, first + lane_first + step)
    }

    /// How many panels further the one is that the thread of `task` probably takes next. Zero where it takes
    /// an earlier one, which the first block has brought into a cache.
    pub(super) fn ahead(&self, task: usize) -> usize {
        let next = task + self.threads;
        if next >= self.tasks() {
            return 0;
        }
        self.at(next).1.saturating_sub(self.at(task).1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_block_passes_every_panel_once() {
        for threads in [1, 2, 3, 8] {
            for (blocks, panels, in_group) in [
                (1, 1, 1),
                (1, 7, 2),
                (3, 1, 4),
                (3, 7, 3),
                (17, 32, 5),
                (2, 128, 128),
            ] {
                let schedule = Schedule::new(blocks, panels, GROUP_BYTES / in_group, threads, 1);
                let mut seen: Vec<_> = (0..schedule.tasks()).map(|task| schedule.at(task)).collect();
                seen.sort_unstable();
                let all: Vec<_> = (0..blocks)
                    .flat_map(|block| (0..panels).map(move |panel| (block, panel)))
                    .collect();
                assert_eq!(seen, all, "{schedule:?}");
            }
        }
    }

    /// Panels that are not among the `held` used last, which a cache of that size would have to read.
    fn reads(schedule: &Schedule, held: usize) -> usize {
        let mut cache: Vec<usize> = Vec::new();
        let mut reads = 0;
        for task in 0..schedule.tasks() {
            let panel = schedule.at(task).1;
            match cache.iter().position(|&other| other == panel) {
                Some(index) => drop(cache.remove(index)),
                None => reads += 1,
            }
            cache.push(panel);
            if cache.len() > held {
                cache.remove(0);
            }
        }
        reads
    }

    #[test]
    fn weights_come_from_memory_once_for_all_rows() {
        let panel_bytes = 4 * 1536 * 48;
        let schedule = Schedule::new(17, 128, panel_bytes, 2, 4);
        let held = GROUP_BYTES / panel_bytes;
        assert_eq!(reads(&schedule, held), 128);
        // As before: one block after the other through all panels.
        let one_group = Schedule {
            groups: 1,
            ..schedule
        };
        assert_eq!(reads(&one_group, held), 17 * 128);
    }

    #[test]
    fn groups_are_not_smaller_than_what_threads_need() {
        let schedule = Schedule::new(17, 128, GROUP_BYTES, 16, 4);
        assert_eq!(schedule.groups, 2);
        assert_eq!(Schedule::new(2, 5, 0, 1, 1).groups, 1);
        assert_eq!(Schedule::new(1, 128, GROUP_BYTES, 1, 1).groups, 1, "one block");
    }

    #[test]
    fn threads_that_take_turns_are_apart_and_go_on_to_the_next_panel() {
        let schedule = Schedule::new(1, 7, 1, 2, 1);
        let panels: Vec<_> = (0..7).map(|task| schedule.at(task).1).collect();
        assert_eq!(panels, [0, 4, 1, 5, 2, 6, 3]);
        let ahead: Vec<_> = (0..7).map(|task| schedule.ahead(task)).collect();
        assert_eq!(ahead, [1, 1, 1, 1, 1, 0, 0]);
    }

    #[test]
    fn the_next_panel_is_asked_for_unless_it_was_there_before() {
        let schedule = Schedule {
            blocks: 2,
            panels: 8,
            groups: 2,
            threads: 2,
        };
        // The first block takes panels 0 to 3, the second takes them, then the first takes 4 to 7.
        let panels: Vec<_> = (0..16).map(|task| schedule.at(task).1).collect();
        assert_eq!(panels, [0, 2, 1, 3, 0, 2, 1, 3, 4, 6, 5, 7, 4, 6, 5, 7]);
        let ahead: Vec<_> = (0..16).map(|task| schedule.ahead(task)).collect();
        assert_eq!(ahead, [1, 1, 0, 0, 1, 1, 3, 3, 1, 1, 0, 0, 1, 1, 0, 0]);
    }
}
