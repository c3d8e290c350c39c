//! Sentences of NMEA 0183: positions of GGA, dates of RMC, standard deviations of GST.

use ::nmea::sentences::{GgaData, GstData};
use ::nmea::{Error, ParseResult, parse_str};
use chrono::{NaiveDate, NaiveTime, Timelike as _};

use crate::georeference::{Geodetic, GeodeticFix};
use crate::recording::found_fixes::{FoundFixes, is_position};

const DAY_S: f64 = 86_400.0;

/// Reads all sentences; those that are damaged are counted. `None` where no line has one.
pub fn parse(text: &str) -> Option<FoundFixes> {
    if !text.lines().any(|line| sentence(line).is_some()) {
        return None;
    }
    let mut found = FoundFixes::default();
    let sentences = || {
        let lines = text.lines().map(|line| sentence(line).unwrap_or(line));
        lines.map(str::trim).filter(|line| !line.is_empty())
    };
    let parsed = |line: &str| parse_str(line).ok();
    // Sentences before the first date are of the same day as it, or of that before.
    let mut clock = Clock {
        last_s: sentences().find_map(|line| date_of(&parsed(line)?)),
    };
    if clock.last_s.is_none() {
        tracing::warn!(
            "the sentences of NMEA have no date (RMC): their times are those of the day, set clock_offset_s to the begin of the day of the recording"
        );
    }
    let mut heights = Heights::default();
    for line in sentences() {
        match parse_str(line) {
            Ok(ParseResult::GGA(gga)) => match fix(&gga, &mut clock, &mut heights) {
                Some(fix) => found.fixes.push(fix),
                None => found.without_position += 1,
            },
            Ok(ParseResult::GST(gst)) => add_deviations(&mut found.fixes, &gst, &mut clock),
            Ok(result) => clock.last_s = date_of(&result).or(clock.last_s),
            // Sentences that are whole, and of a kind that is not read.
            Err(Error::Unsupported(_) | Error::Unknown(_) | Error::DisabledSentence) => {}
            Err(_) => found.bad_lines += 1,
        }
    }
    // Without the separation of the geoid in every fix, heights are those above the sea in all.
    if heights.has_without_separation {
        for (fix, separation_m) in found.fixes.iter_mut().zip(&heights.separations_m) {
            fix.position.height_m -= separation_m;
        }
        found.is_above_sea = true;
    }
    Some(found)
}

/// The sentence in a line, such as `$GPGGA,...`. Loggers write times before them, and receivers other messages between them.
fn sentence(line: &str) -> Option<&str> {
    let found = &line[line.rfind('$')?..];
    let (name, _) = found[1..].split_once(',')?;
    let is_name = name.len() == 5 && name.bytes().all(|letter| letter.is_ascii_alphanumeric());
    (is_name && !line.trim_start().starts_with('#')).then_some(found)
}

/// Separations of the geoid that were added to the heights of fixes.
#[derive(Default)]
struct Heights {
    separations_m: Vec<f64>,
    has_without_separation: bool,
}

/// The time of the last sentence [s since 1970].
struct Clock {
    last_s: Option<f64>,
}

impl Clock {
    /// The moment at a time of the day that is nearest to the last one.
    fn at(&mut self, time: NaiveTime) -> f64 {
        let of_day_s = of_day_s(time);
        let last_s = self.last_s.unwrap_or(of_day_s);
        let days = ((last_s - of_day_s) / DAY_S).round();
        let time_s = days * DAY_S + of_day_s;
        self.last_s = Some(time_s);
        time_s
    }
}

fn of_day_s(time: NaiveTime) -> f64 {
    f64::from(time.num_seconds_from_midnight()) + 1e-9 * f64::from(time.nanosecond())
}

/// The moment of a sentence with a date.
fn date_of(result: &ParseResult) -> Option<f64> {
    let ParseResult::RMC(rmc) = result else {
        return None;
    };
    let days = (rmc.fix_date? - NaiveDate::default()).num_days();
    Some(days as f64 * DAY_S + of_day_s(rmc.fix_time?))
}

/// The fix of a sentence; `None` without a position.
fn fix(gga: &GgaData, clock: &mut Clock, heights: &mut Heights) -> Option<GeodeticFix> {
    let time_s = clock.at(gga.fix_time?);
    gga.fix_type.filter(|fix_type| fix_type.is_valid())?;
    let (latitude_deg, longitude_deg) = (gga.latitude?, gga.longitude?);
    let separation_m = gga.geoid_separation.map_or(0.0, f64::from);
    let height_m = f64::from(gga.altitude?) + separation_m;
    if !is_position(latitude_deg, longitude_deg, height_m) {
        return None;
    }
    heights.has_without_separation |= gga.geoid_separation.is_none();
    heights.separations_m.push(separation_m);
    Some(GeodeticFix {
        time_s,
        position: Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
        },
        horizontal_m: None,
        vertical_m: None,
    })
}

/// Adds the standard deviations to the fix of the same time.
fn add_deviations(fixes: &mut [GeodeticFix], gst: &GstData, clock: &mut Clock) {
    let Some(time) = gst.time else {
        return;
    };
    let time_s = clock.at(time);
    let Some(fix) = fixes.last_mut().filter(|fix| fix.time_s == time_s) else {
        return;
    };
    let positive = |value: Option<f32>| value.map(f64::from).filter(|&m| m > 0.0);
    let axes = positive(gst.lat_sd).zip(positive(gst.long_sd));
    fix.horizontal_m = axes.map(|(lat_m, lon_m)| (0.5 * (lat_m * lat_m + lon_m * lon_m)).sqrt());
    fix.vertical_m = positive(gst.alt_sd);
}
