//! Tables for people, JSON for programs.

use serde_json::{Value, json};

use crate::measure::{Rates, quantile};
use crate::options::Options;

/// Collects the cases of a bench: prints each as it comes, writes all of them at the end.
#[derive(Debug)]
pub struct Report {
    cases: Vec<Value>,
}

impl Report {
    /// Prints what machine this is and what the columns mean; a rate is in `unit` a second.
    #[must_use]
    pub fn begin(title: &str, unit: &str, options: &Options) -> Self {
        println!(
            "{title}\n{}; {} rounds, {:?} clock",
            cpu(),
            options.rounds,
            options.clock
        );
        println!("rates in {unit} a second: median [10 % .. 90 % of the samples]");
        Self { cases: Vec::new() }
    }

    /// Prints one case, and how rates grow with the threads.
    pub fn case(&mut self, name: &str, rates: &[Rates]) {
        println!("\n{name}");
        println!(
            "{:<34}{:>8}{:>10}{:>20}{:>14}{:>18}{:>10}",
            "", "threads", "rate", "", "of peak", "", "x first"
        );
        for entry in rates {
            let first = rates
                .iter()
                .find(|other| other.name == entry.name)
                .map_or(1.0, |other| median(&other.rates));
            let spread = |samples: &[f64], digits| {
                format!(
                    "[{:.digits$} .. {:.digits$}]",
                    quantile(samples, 0.1),
                    quantile(samples, 0.9)
                )
            };
            let (ratio, ratios) = if entry.ratios.is_empty() {
                (String::new(), String::new())
            } else {
                (format!("{:.3}", median(&entry.ratios)), spread(&entry.ratios, 3))
            };
            println!(
                "{:<34}{:>8}{:>10.1}{:>20}{:>14}{:>18}{:>10.2}",
                entry.name,
                entry.threads,
                median(&entry.rates),
                spread(&entry.rates, 1),
                ratio,
                ratios,
                median(&entry.rates) / first,
            );
        }
        let rates: Vec<_> = rates
            .iter()
            .map(|entry| {
                json!({
                    "name": entry.name,
                    "threads": entry.threads,
                    "gmacs": summary(&entry.rates),
                    "of_peak": summary(&entry.ratios),
                })
            })
            .collect();
        self.cases.push(json!({ "case": name, "rates": rates }));
    }

    /// Writes the JSON file, if one was asked for.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn end(self, options: &Options) {
        if let Some(path) = &options.json {
            let text = json!({ "cpu": cpu(), "clock": format!("{:?}", options.clock), "cases": self.cases });
            std::fs::write(path, format!("{text:#}\n")).expect("the JSON file can be written");
        }
    }
}

fn median(samples: &[f64]) -> f64 {
    quantile(samples, 0.5)
}

fn summary(samples: &[f64]) -> Value {
    json!({ "median": quantile(samples, 0.5), "p10": quantile(samples, 0.1), "p90": quantile(samples, 0.9), "samples": samples.len() })
}

/// The CPU's name, if the system provides it.
#[must_use]
pub fn cpu() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!(
        "{}, {cores} cores",
        name.map_or(std::env::consts::ARCH, |(_, name)| name)
    )
}
