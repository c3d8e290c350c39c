//! Runs a reader on many inputs, and checks time, memory and panics.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Once};
use std::time::{Duration, Instant};

use arbtest::arbitrary::{Result, Unstructured};
use arbtest::arbtest;

use super::allocation::peak_of;
use super::mutation::Mutations;

/// Number of inputs per reader without `FPMCL_FUZZ_INPUTS`.
const FEW: u32 = 1_500;

const TIME_LIMIT: Duration = Duration::from_secs(1);

const MEMORY_LIMIT: usize = 1 << 30;

/// Failures of a reader after which the others are not looked for.
const MOST_FAILURES: usize = 10;

/// An input in its file.
pub struct Input<'a> {
    pub path: &'a Path,
    pub bytes: &'a [u8],
}

impl Input<'_> {
    /// Writes what was read into another file.
    pub fn write_beside(&self, written: &[u8]) -> PathBuf {
        let path = self.written();
        fs::write(&path, written).unwrap();
        path
    }

    /// The path of a file for what was read.
    pub fn written(&self) -> PathBuf {
        let name = self.path.file_name().unwrap().to_str().unwrap();
        self.path.with_file_name(format!("written-{name}"))
    }
}

/// What happened with the inputs of a reader.
#[derive(Default)]
struct Counts {
    inputs: usize,
    values: usize,
    errors: usize,
    slowest: Duration,
    most_bytes: usize,
}

/// Time that this thread has computed, or the time of day where the system does not report it.
fn processor_time() -> Duration {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    let report = fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = report.split(' ').next().and_then(|word| word.parse().ok());
    nanoseconds.map_or_else(|| START.elapsed(), Duration::from_nanos)
}

/// Fuzzes a reader. `generate` returns a valid file, which is then changed; `read` reads it, checks
/// the value and returns the message of an error, which must name the file.
pub fn fuzz(
    reader: &str,
    file_name: &str,
    generate: impl Fn(&mut Unstructured) -> Result<Vec<u8>>,
    read: impl Fn(&Input) -> std::result::Result<(), String>,
) {
    let folder = folder().join(reader.replace('/', "-"));
    fs::create_dir_all(&folder).unwrap();
    let path = folder.join(file_name);
    let mut counts = Counts::default();
    let mut property = |u: &mut Unstructured| {
        let mutations = Mutations::new(u)?;
        let mut bytes = generate(u)?;
        mutations.apply(&mut bytes);
        fs::write(&path, &bytes).unwrap();
        let input = Input {
            path: &path,
            bytes: &bytes,
        };
        let measured = || {
            let start = processor_time();
            let (outcome, bytes) = peak_of(|| read(&input));
            (outcome, bytes, processor_time() - start)
        };
        let (outcome, bytes, elapsed) = measured();
        counts.inputs += 1;
        counts.slowest = counts.slowest.max(elapsed);
        counts.most_bytes = counts.most_bytes.max(bytes);
        match outcome {
            Ok(()) => counts.values += 1,
            Err(message) => {
                counts.errors += 1;
                assert!(message.contains(file_name), "no file: {message}");
            }
        }
        assert!(elapsed <= TIME_LIMIT, "{elapsed:?} for one input");
        assert!(bytes <= MEMORY_LIMIT, "{bytes} bytes for one input");
        Ok(())
    };
    if std::env::var_os("ARBTEST_SEED").is_some() {
        return arbtest(property).run();
    }
    let inputs = std::env::var("FPMCL_FUZZ_INPUTS").map_or(FEW, |text| text.parse().unwrap());
    let mut failures = 0;
    for input in 1..=inputs {
        let run = || arbtest(&mut property).seed(seed(input)).run();
        if catch_unwind(AssertUnwindSafe(run)).is_err() {
            failures += 1;
            if failures == MOST_FAILURES {
                break;
            }
        }
    }
    report(reader, &counts, failures);
    assert_eq!(failures, 0, "{reader}: see the messages above");
    fs::remove_dir_all(&folder).unwrap();
}

/// A folder for the inputs: in memory where there is one, else in the build folder.
fn folder() -> PathBuf {
    let memory = Path::new("/dev/shm");
    let disk = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let parent = if memory.is_dir() { memory } else { disk };
    parent.join(format!("fpmcl-fuzzing-{}", std::process::id()))
}

/// The seed of an input: the amount of randomness in the low half, different for each input in the
/// high one.
fn seed(input: u32) -> u64 {
    let bytes = 128 << (input % 6);
    u64::from(input.wrapping_mul(0x9e37_79b1)) << 32 | bytes
}

fn report(reader: &str, counts: &Counts, failures: usize) {
    static HEAD: Once = Once::new();
    HEAD.call_once(|| {
        println!(
            "| reader | inputs | values | errors | slowest input [ms] | most memory [MB] | failures |\n\
             |---|---:|---:|---:|---:|---:|---:|"
        );
    });
    println!(
        "| {reader} | {} | {} | {} | {:.1} | {:.1} | {failures} |",
        counts.inputs,
        counts.values,
        counts.errors,
        1e3 * counts.slowest.as_secs_f64(),
        counts.most_bytes as f64 / 1e6,
    );
}
