//! Properties of the machine, for records of what was measured.

use std::collections::BTreeMap;
use std::fs;

/// Processor, threads, memory and system, by name.
pub fn properties(threads: usize) -> BTreeMap<String, String> {
    let (system, architecture) = (std::env::consts::OS, std::env::consts::ARCH);
    [
        (
            "processor",
            processor().unwrap_or_else(|| "unknown".to_owned()),
        ),
        ("threads", threads.to_string()),
        ("memory", memory().unwrap_or_else(|| "unknown".to_owned())),
        ("system", format!("{system} {architecture}")),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// Name of the processor, on systems with `/proc/cpuinfo`.
fn processor() -> Option<String> {
    let text = fs::read_to_string("/proc/cpuinfo").ok()?;
    let name = text.lines().find(|line| line.starts_with("model name"))?;
    Some(name.split_once(':')?.1.trim().to_owned())
}

/// Size of the memory, on systems with `/proc/meminfo`.
fn memory() -> Option<String> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"));
    let kib: f64 = line?.trim().strip_suffix(" kB")?.parse().ok()?;
    Some(format!("{:.1} GiB", kib / f64::from(1 << 20)))
}
