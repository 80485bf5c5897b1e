//! Command line of the benches: `cargo bench -p saccade-benches --bench linear -- --threads 1,2 --rounds 30 --json out.json`.

use std::path::PathBuf;

/// What is measured as time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// The wall's: what users wait for. Valid on a quiet machine only.
    Wall,
    /// Processor time of this process: for one thread on a machine that others use too.
    Processor,
}

/// Options that all benches take.
#[derive(Clone, Debug)]
pub struct Options {
    /// Thread counts to measure.
    pub threads: Vec<usize>,
    /// Samples of each contender.
    pub rounds: usize,
    /// Where the numbers go as JSON.
    pub json: Option<PathBuf>,
    /// Wall time or processor time.
    pub clock: Clock,
    /// Only cases whose name contains it.
    pub filter: Option<String>,
    /// Whether other libraries are measured too.
    pub peers: bool,
}

const USAGE: &str = "\
  --threads 1,2     thread counts (default 1,2)
  --rounds N        samples of each contender (default 30)
  --clock wall|cpu  wall time, or processor time for one thread on a busy machine (default wall)
  --json PATH       writes the numbers as JSON
  --no-peers        saccade only
  FILTER            only cases whose name contains it";

impl Options {
    /// Reads the process's arguments; prints the usage and ends the process if they are wrong.
    #[must_use]
    pub fn from_args() -> Self {
        match Self::parse(std::env::args().skip(1)) {
            Ok(options) => options,
            Err(message) => {
                eprintln!("{message}\n{USAGE}");
                std::process::exit(2);
            }
        }
    }

    fn parse(mut args: impl Iterator<Item = String>) -> Result<Self, String> {
        let mut options = Self {
            threads: vec![1, 2],
            rounds: 30,
            json: None,
            clock: Clock::Wall,
            filter: None,
            peers: true,
        };
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{arg}: a value is missing"));
            match arg.as_str() {
                // Cargo passes it to every bench.
                "--bench" => {}
                "--no-peers" => options.peers = false,
                "--threads" => {
                    let threads: Result<_, _> = value()?.split(',').map(str::parse).collect();
                    options.threads = threads.map_err(|error| format!("--threads: {error}"))?;
                }
                "--rounds" => {
                    options.rounds = value()?.parse().map_err(|error| format!("--rounds: {error}"))?;
                }
                "--json" => options.json = Some(value()?.into()),
                "--clock" => {
                    options.clock = match value()?.as_str() {
                        "wall" => Clock::Wall,
                        "cpu" => Clock::Processor,
                        other => return Err(format!("--clock: expected wall or cpu, got `{other}`")),
                    };
                }
                "--help" => return Err(String::new()),
                other if other.starts_with('-') => return Err(format!("unknown option `{other}`")),
                other => options.filter = Some(other.to_owned()),
            }
        }
        if options.threads.contains(&0) || options.threads.is_empty() || options.rounds == 0 {
            return Err("--threads and --rounds must be at least 1".to_owned());
        }
        if options.clock == Clock::Processor && options.threads != [1] {
            return Err("--clock cpu measures one thread only: add --threads 1".to_owned());
        }
        Ok(options)
    }

    /// Whether the filter, if any, lets `name` through.
    #[must_use]
    pub fn wants(&self, name: &str) -> bool {
        self.filter
            .as_ref()
            .is_none_or(|filter| name.contains(filter.as_str()))
    }
}
