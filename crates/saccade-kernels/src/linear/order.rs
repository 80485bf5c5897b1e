//! In which order blocks of rows pass the panels of a layer, so that weights come from memory once however many rows there are.
//!
//! All rows in one block would need no order, but their activations would not stay in a core's cache. One block after the other through all
//! panels reads weights that are larger than the caches once a block: 17 times for 32 observations of 49 rows. Panels are therefore taken in
//! groups that the shared cache holds. All blocks pass a group before the next group begins, so its panels come from memory with the first
//! block only, and activations are read once a group.
//!
//! Bytes from memory where the shared cache holds a group but not the layer, bf16, 1568 rows, 2 threads: 1536 x 6144 reads 43 MB (326 MB block by
//! block), 6144 x 1536 reads 96 MB (340 MB). The multiply-adds take 6 ms at the peak of two Sapphire Rapids cores with AMX, in which they can
//! read 160 MB.

/// Bytes of the panels of a group: less than a few cores' part of the shared cache (2 to 4 MB a core on servers), and several times the
/// activations of a block.
const GROUP_BYTES: usize = 4 << 20;

/// Tasks of a call: each a block of rows through a panel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Order {
    blocks: usize,
    panels: usize,
    groups: usize,
    threads: usize,
}

impl Order {
    /// `blocks` of rows through `panels` of `panel_bytes`. A group has `least` panels or more, for threads that work next to each other.
    pub(super) fn new(blocks: usize, panels: usize, panel_bytes: usize, least: usize, threads: usize) -> Self {
        let in_group = (GROUP_BYTES / panel_bytes.max(1)).max(least).max(1);
        Self {
            blocks,
            panels,
            groups: if blocks == 1 { 1 } else { panels.div_ceil(in_group) },
            threads,
        }
    }

    pub(super) fn tasks(&self) -> usize {
        self.blocks * self.panels
    }

    /// The block and the panel of task number `task`. Within a group, blocks outside and panels inside: threads then share a block of
    /// activations and walk the weights next to each other.
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
        let within = task - blocks * first;
        let count = end - first;
        let (turn, lane) = (within % count / threads, within % count % threads);
        (within / count, first + lane * (count / threads) + lane.min(count % threads) + turn)
    }

    /// How many panels further the one is that the thread of `task` probably takes next, if `threads` take turns. Zero where it takes an
    /// earlier one, which the first block has brought into a cache.
    pub(super) fn ahead(&self, task: usize, threads: usize) -> usize {
        let next = task + threads;
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
        for (blocks, panels, in_group) in [
            (1, 1, 1),
            (1, 7, 2),
            (3, 1, 4),
            (3, 7, 3),
            (17, 32, 5),
            (2, 128, 128),
        ] {
            let order = Order::new(blocks, panels, GROUP_BYTES / in_group, 1);
            let mut seen: Vec<_> = (0..order.tasks()).map(|task| order.at(task)).collect();
            seen.sort_unstable();
            let all: Vec<_> = (0..blocks)
                .flat_map(|block| (0..panels).map(move |panel| (block, panel)))
                .collect();
            assert_eq!(seen, all, "{order:?}");
        }
    }

    /// Panels that are not among the `held` used last, which a cache of that size would have to read.
    fn reads(order: &Order, held: usize) -> usize {
        let mut cache: Vec<usize> = Vec::new();
        let mut reads = 0;
        for task in 0..order.tasks() {
            let panel = order.at(task).1;
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
        let order = Order::new(17, 128, panel_bytes, 8);
        let held = GROUP_BYTES / panel_bytes;
        assert_eq!(reads(&order, held), 128);
        // As before: one block after the other through all panels.
        let one_group = Order { groups: 1, ..order };
        assert_eq!(reads(&one_group, held), 17 * 128);
    }

    #[test]
    fn groups_are_not_smaller_than_what_threads_need() {
        let order = Order::new(17, 128, GROUP_BYTES, 64);
        assert_eq!(order.groups, 2);
        assert_eq!(Order::new(1, 5, 0, 0).groups, 1);
    }

    #[test]
    fn the_next_panel_is_asked_for_unless_it_was_there_before() {
        let order = Order {
            blocks: 2,
            panels: 6,
            groups: 2,
        };
        let ahead = |task| order.ahead(task, 2);
        // Tasks: panels 0 1 2, 0 1 2, 3 4 5, 3 4 5.
        let panels: Vec<_> = (0..12).map(|task| order.at(task).1).collect();
        assert_eq!(panels, [0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5]);
        let expected = [2, 0, 0, 2, 2, 2, 2, 0, 0, 2, 0, 0];
        assert_eq!((0..12).map(ahead).collect::<Vec<_>>(), expected);
    }
}
