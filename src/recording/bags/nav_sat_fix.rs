//! Positions of `sensor_msgs/NavSatFix`.

use super::fields::Fields;
use super::message::Header;
use crate::georeference::{Geodetic, GeodeticFix};
use crate::recording::found_fixes::is_position;

/// A message of a receiver.
pub struct ReceiverMessage {
    /// Name of the frame of the antenna.
    pub frame: String,
    /// The position; `None` where the receiver has none.
    pub fix: Option<GeodeticFix>,
}

/// Reads a message; `log_s` is its moment if it has no stamp.
pub fn read(fields: &mut Fields, log_s: f64) -> Result<ReceiverMessage, String> {
    /// `STATUS_NO_FIX`, a signed byte of -1.
    const NO_FIX: u8 = 0xff;
    /// `COVARIANCE_TYPE_UNKNOWN`.
    const UNKNOWN: u8 = 0;
    let header = Header::read(fields)?;
    let (status, _service) = (fields.u8()?, fields.u16()?);
    let (latitude_deg, longitude_deg, height_m) = (fields.f64()?, fields.f64()?, fields.f64()?);
    let mut covariance = [0.0; 9];
    for number in &mut covariance {
        *number = fields.f64()?;
    }
    let is_known = fields.u8()? != UNKNOWN;
    let deviation =
        |variance: f64| Some(variance.sqrt()).filter(|&m| is_known && m > 0.0 && m.is_finite());
    let fix = GeodeticFix {
        time_s: if header.stamp_s == 0.0 {
            log_s
        } else {
            header.stamp_s
        },
        position: Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
        },
        horizontal_m: deviation(0.5 * (covariance[0] + covariance[4])),
        vertical_m: deviation(covariance[8]),
    };
    let has_position = status != NO_FIX && is_position(latitude_deg, longitude_deg, height_m);
    Ok(ReceiverMessage {
        frame: header.frame,
        fix: has_position.then_some(fix),
    })
}
