//! How many threads a process should use by default: the fast physical cores that it is allowed to run on.
//!
//! One thread a core is right for both limits of a call. Many rows are bound by arithmetic: siblings share one core's multipliers. Few rows
//! are bound by memory: siblings share one core's requests to it. On hybrid CPUs an efficiency core does about a third of the multiply-adds
//! of a performance core (half the vector width at three quarters of the clock): threads there would add little to the first limit and
//! nothing to the second, and a robot has other work for them. How many of these threads a product gets depends on its size (`linear`).
//! `benches/peers/throughput.py` measures from which number of threads on memory is the limit of a machine.

use std::num::NonZeroUsize;

/// Environment variable that sets the default number of threads.
pub const NUM_THREADS_VARIABLE: &str = "SACCADE_NUM_THREADS";

/// `SACCADE_NUM_THREADS` is not a positive whole number.
#[derive(Debug, thiserror::Error)]
#[error("{NUM_THREADS_VARIABLE}: expected a whole number of at least 1, got `{given}`")]
pub struct NumThreadsError {
    given: String,
}

/// `SACCADE_NUM_THREADS`; where it is unset or empty, the number of fast physical cores that this process may use.
///
/// The affinity mask and the quota of the control group (v1 and v2, rounded up) are counted; siblings of one core count once. On Linux,
/// cores of less than half the capacity of the fastest one (Arm's LITTLE cores) and Intel's efficiency cores are not counted, unless the
/// process may use no others.
/// Other systems than Linux count logical processors.
///
/// # Errors
/// The variable holds something else than a whole number of at least 1.
///
/// ```
/// assert!(saccade_vla_kernels::default_num_threads().unwrap().get() >= 1);
/// ```
pub fn default_num_threads() -> Result<NonZeroUsize, NumThreadsError> {
    match std::env::var_os(NUM_THREADS_VARIABLE) {
        Some(given) if !given.is_empty() => parse(&given.to_string_lossy()),
        _ => Ok(usable_cores()),
    }
}

fn parse(given: &str) -> Result<NonZeroUsize, NumThreadsError> {
    given.trim().parse().map_err(|_| NumThreadsError {
        given: given.to_owned(),
    })
}

fn usable_cores() -> NonZeroUsize {
    // Already takes into account the affinity mask and, rounded down, the quota of the control group.
    let logical = std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
    #[cfg(target_os = "linux")]
    let logical = linux::physical_cores().unwrap_or(logical);
    NonZeroUsize::new(logical).unwrap_or(NonZeroUsize::MIN)
}

/// What the operating system says about this process, read from files. Anything that cannot be read or understood sets no limit.
#[cfg(target_os = "linux")]
mod linux {
    use std::collections::BTreeSet;
    use std::path::{Path, PathBuf};

    pub(super) fn physical_cores() -> Option<usize> {
        let read = |path: &Path| std::fs::read_to_string(path).ok();
        let cores = allowed_cores(&read)?;
        let quota = quota(&read).unwrap_or(usize::MAX);
        Some(cores.min(quota).max(1))
    }

    /// Distinct fast cores among the processors that the affinity mask allows.
    fn allowed_cores(read: &impl Fn(&Path) -> Option<String>) -> Option<usize> {
        let status = read(Path::new("/proc/self/status"))?;
        let list = status
            .lines()
            .find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
        let core = |cpu: usize| {
            let topology = format!("/sys/devices/system/cpu/cpu{cpu}/topology");
            let siblings = read(&PathBuf::from(topology).join("thread_siblings_list"));
            // Processors that share a core have the same list; without topology each is a core.
            siblings.map_or_else(|| cpu.to_string(), |list| list.trim().to_owned())
        };
        let cores: BTreeSet<String> = fast(read, parse_list(list)?).into_iter().map(core).collect();
        (!cores.is_empty()).then_some(cores.len())
    }

    /// Those of `cpus` that are not on slow cores of a hybrid CPU; all of them where there is nothing else.
    fn fast(read: &impl Fn(&Path) -> Option<String>, mut cpus: Vec<usize>) -> Vec<usize> {
        // Relative to the fastest core, which has 1024. Clock rates would not tell: an efficiency core also does less in a cycle.
        let capacity = |cpu: usize| {
            let path = format!("/sys/devices/system/cpu/cpu{cpu}/cpu_capacity");
            read(Path::new(&path))?.trim().parse::<u64>().ok()
        };
        let capacities: Option<Vec<u64>> = cpus.iter().map(|&cpu| capacity(cpu)).collect();
        if let Some(capacities) = capacities {
            let largest = capacities.iter().copied().max().unwrap_or(0);
            let mut capacities = capacities.into_iter();
            cpus.retain(|_| capacities.next().is_some_and(|capacity| 2 * capacity >= largest));
            return cpus;
        }
        // Intel's hybrids: each kind of core has counters of its own.
        let slow = read(Path::new("/sys/devices/cpu_atom/cpus")).and_then(|list| parse_list(&list));
        let slow: BTreeSet<usize> = slow.unwrap_or_default().into_iter().collect();
        if !cpus.iter().all(|cpu| slow.contains(cpu)) {
            cpus.retain(|cpu| !slow.contains(cpu));
        }
        cpus
    }

    /// `0-3,8` and the like.
    fn parse_list(list: &str) -> Option<Vec<usize>> {
        let mut cpus = Vec::new();
        for part in list.trim().split(',').filter(|part| !part.is_empty()) {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
            cpus.extend(first..=last);
        }
        Some(cpus)
    }

    /// The tightest quota among the control groups that hold this process, in whole processors, rounded up.
    fn quota(read: &impl Fn(&Path) -> Option<String>) -> Option<usize> {
        let groups = read(Path::new("/proc/self/cgroup"))?;
        let mut tightest = None;
        for line in groups.lines() {
            let mut fields = line.splitn(3, ':').skip(1);
            let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else {
                continue;
            };
            let (root, v2) = if controllers.is_empty() {
                ("/sys/fs/cgroup", true)
            } else if controllers.split(',').any(|controller| controller == "cpu") {
                ("/sys/fs/cgroup/cpu", false)
            } else {
                continue;
            };
            // A limit may sit on any group above; inside a container the path may not exist, but the root is its own group.
            for group in Path::new(path.trim_start_matches('/')).ancestors() {
                let limit = group_quota(read, &Path::new(root).join(group), v2);
                tightest = tightest.into_iter().chain(limit).min();
            }
        }
        tightest
    }

    fn group_quota(read: &impl Fn(&Path) -> Option<String>, group: &Path, v2: bool) -> Option<usize> {
        let (quota, period) = if v2 {
            let max = read(&group.join("cpu.max"))?;
            let (quota, period) = max.trim().split_once(' ')?;
            (quota.parse::<u64>().ok()?, period.parse::<u64>().ok()?)
        } else {
            let number = |name| read(&group.join(name))?.trim().parse::<u64>().ok();
            (number("cpu.cfs_quota_us")?, number("cpu.cfs_period_us")?)
        };
        (period > 0).then(|| {
            usize::try_from(quota.div_ceil(period))
                .unwrap_or(usize::MAX)
                .max(1)
        })
    }

    #[cfg(test)]
    mod tests {
        use std::collections::BTreeMap;

        use super::*;

        fn files(files: &[(&str, &str)]) -> impl Fn(&Path) -> Option<String> {
            let files: BTreeMap<PathBuf, String> = files
                .iter()
                .map(|(path, text)| (path.into(), format!("{text}\n")))
                .collect();
            move |path| files.get(path).cloned()
        }

        /// A machine that allows these processors, with files of `/sys/devices` about them.
        fn machine(allowed: &str, about: &[(&str, &str)]) -> impl Fn(&Path) -> Option<String> {
            let status = format!("Name:\tx\nCpus_allowed_list:\t{allowed}\n");
            let devices = files(about);
            move |path| match path.strip_prefix("/sys/devices") {
                Ok(path) => devices(path),
                Err(_) => (path == Path::new("/proc/self/status")).then(|| status.clone()),
            }
        }

        #[test]
        fn siblings_count_once() {
            let read = machine(
                "0-2,5",
                &[
                    ("system/cpu/cpu0/topology/thread_siblings_list", "0,4"),
                    ("system/cpu/cpu1/topology/thread_siblings_list", "1,5"),
                    ("system/cpu/cpu2/topology/thread_siblings_list", "2,6"),
                    ("system/cpu/cpu5/topology/thread_siblings_list", "1,5"),
                ],
            );
            assert_eq!(allowed_cores(&read), Some(3));
        }

        #[test]
        fn without_topology_every_processor_is_a_core() {
            assert_eq!(allowed_cores(&machine("0-2,5", &[])), Some(4));
            assert_eq!(allowed_cores(&machine("x", &[])), None);
            assert_eq!(allowed_cores(&files(&[])), None);
        }

        #[test]
        fn little_cores_do_not_count() {
            let read = machine(
                "0-3",
                &[
                    ("system/cpu/cpu0/cpu_capacity", "398"),
                    ("system/cpu/cpu1/cpu_capacity", "398"),
                    ("system/cpu/cpu2/cpu_capacity", "1024"),
                    ("system/cpu/cpu3/cpu_capacity", "700"),
                ],
            );
            assert_eq!(allowed_cores(&read), Some(2));
            assert_eq!(fast(&read, vec![0, 1]), [0, 1]); // no others may be used
            assert_eq!(fast(&read, vec![0, 2, 4]), [0, 2, 4]); // of one nothing is known
        }

        #[test]
        fn efficiency_cores_do_not_count() {
            let read = machine(
                "0-7",
                &[
                    ("cpu_core/cpus", "0-3"),
                    ("cpu_atom/cpus", "4-7"),
                    ("system/cpu/cpu0/topology/thread_siblings_list", "0-1"),
                    ("system/cpu/cpu1/topology/thread_siblings_list", "0-1"),
                    ("system/cpu/cpu2/topology/thread_siblings_list", "2-3"),
                    ("system/cpu/cpu3/topology/thread_siblings_list", "2-3"),
                ],
            );
            assert_eq!(allowed_cores(&read), Some(2));
            assert_eq!(fast(&read, vec![5, 6]), [5, 6]);
        }

        #[test]
        fn quota_of_version_2_is_the_tightest_above() {
            let read = files(&[
                ("/proc/self/cgroup", "0::/a/b"),
                ("/sys/fs/cgroup/a/b/cpu.max", "max 100000"),
                ("/sys/fs/cgroup/a/cpu.max", "250000 100000"),
                ("/sys/fs/cgroup/cpu.max", "800000 100000"),
            ]);
            assert_eq!(quota(&read), Some(3));
        }

        #[test]
        fn quota_of_version_1() {
            let read = files(&[
                ("/proc/self/cgroup", "5:memory:/x\n4:cpu,cpuacct:/x"),
                ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "150000"),
                ("/sys/fs/cgroup/cpu/cpu.cfs_period_us", "100000"),
                ("/sys/fs/cgroup/cpu/x/cpu.cfs_quota_us", "-1"),
                ("/sys/fs/cgroup/cpu/x/cpu.cfs_period_us", "100000"),
            ]);
            assert_eq!(quota(&read), Some(2));
        }

        #[test]
        fn no_quota() {
            let read = files(&[
                ("/proc/self/cgroup", "0::/"),
                ("/sys/fs/cgroup/cpu.max", "max 100000"),
            ]);
            assert_eq!(quota(&read), None);
            assert_eq!(quota(&files(&[])), None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variable_must_be_a_positive_whole_number() {
        assert_eq!(parse(" 3 ").unwrap().get(), 3);
        for given in ["0", "-1", "two", "1.5"] {
            let message = parse(given).unwrap_err().to_string();
            assert!(
                message.contains("SACCADE_NUM_THREADS") && message.contains(given),
                "{message}"
            );
        }
    }

    #[test]
    fn at_least_one_and_no_more_than_allowed() {
        let logical = std::thread::available_parallelism().unwrap();
        // One more, because the standard library rounds a quota down.
        assert!(usable_cores().get() <= logical.get() + 1);
    }
}
