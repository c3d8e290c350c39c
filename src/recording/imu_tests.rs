//! Tables with and without units, and KITTI's oxts.

use std::fs;

use approx::assert_relative_eq;

use super::*;

fn sample(row: u32) -> ImuSample {
    let time_s = 0.01 * f64::from(row);
    ImuSample {
        time_s: 1.7e9 + time_s,
        rate_rad_s: Vector3::new(0.1 * time_s.sin(), -0.2, 0.5 * time_s.cos()),
        force_m_s2: Vector3::new(time_s.sin(), 0.3, GRAVITY_M_S2),
    }
}

/// Reads a text as a table; measurements, or the message.
fn read(text: &str) -> Result<Vec<ImuSample>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("imu.csv");
    fs::write(&path, text).unwrap();
    read_table(&path).map_err(|error| error.to_string())
}

/// Rows in units of the times, rates and forces.
fn rows(separator: &str, [per_s, per_rad, per_m_s2]: [f64; 3]) -> String {
    let row = |row| {
        let ImuSample {
            time_s,
            rate_rad_s: rate,
            force_m_s2: force,
        } = sample(row);
        let numbers = [
            time_s * per_s,
            rate.x * per_rad,
            rate.y * per_rad,
            rate.z * per_rad,
            force.x * per_m_s2,
            force.y * per_m_s2,
            force.z * per_m_s2,
        ];
        numbers.map(|number| number.to_string()).join(separator) + "\n"
    };
    (0..500).map(row).collect()
}

fn assert_read(text: &str) {
    let found = read(text).unwrap();
    assert_eq!(found.len(), 500);
    for (row, found) in (0..).zip(&found) {
        let expected = sample(row);
        assert_relative_eq!(found.time_s, expected.time_s, epsilon = 2e-6);
        assert_relative_eq!(found.rate_rad_s, expected.rate_rad_s, epsilon = 1e-6);
        assert_relative_eq!(found.force_m_s2, expected.force_m_s2, epsilon = 1e-5);
    }
}

const SI: [f64; 3] = [1.0, 1.0, 1.0];
const OTHER: [f64; 3] = [1e9, 57.295_779_513_082_32, 1.0 / GRAVITY_M_S2];

#[test]
fn a_written_table_reads_back() {
    let samples: Vec<ImuSample> = (0..500).map(sample).collect();
    let mut bytes = vec![];
    write_table(&mut bytes, &samples).unwrap();
    assert_read(&String::from_utf8(bytes).unwrap());
}

#[test]
fn units_are_those_of_the_header_or_are_found() {
    assert_read(&rows(" ", SI));
    assert_read(&rows(",", OTHER));
    assert_read(&format!(
        "# a comment\n# timestamp [ns], w_x [deg/s], w_y [deg/s], w_z [deg/s], a_x [g], a_y [g], a_z [g]\n{}",
        rows(",", OTHER)
    ));
    assert_read(&format!("t wx wy wz ax ay az\n{}", rows("\t", OTHER)));
    // That of EuRoC.
    assert_read(&format!(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n{}",
        rows(",", [1e9, 1.0, 1.0])
    ));
}

#[test]
fn columns_have_the_order_of_the_header() {
    // Each triple from z to x, as in Boreas, and drivers' names.
    for header in [
        "GPSTime,angvel_z,angvel_y,angvel_x,accelz,accely,accelx",
        "sec,gz,gy,gx,az,ay,ax",
        "t,wz,wy,wx,forcez,forcey,forcex",
        "time_s,gyro_z_rad_s,gyro_y_rad_s,gyro_x_rad_s,acc_z_m_s2,acc_y_m_s2,acc_x_m_s2",
    ] {
        let samples = read(&format!(
            "{header}\n1,3,2,1,9.8,0.5,0.4\n1.01,3,2,1,9.8,0.5,0.4\n"
        ))
        .unwrap();
        assert_eq!(
            samples[0].rate_rad_s,
            Vector3::new(1.0, 2.0, 3.0),
            "{header}"
        );
        assert_eq!(
            samples[0].force_m_s2,
            Vector3::new(0.4, 0.5, 9.8),
            "{header}"
        );
    }
    // Two axes of one name, and whole seconds without their fraction.
    for header in [
        "t,gyro_x,gyro_x,gyro_z,ax,ay,az",
        "sec,nsec,gx,gy,gz,ax,ay,az",
    ] {
        assert!(read(&format!("{header}\n1,0,1,2,3,0,0,9.8\n")).is_err());
    }
    // Columns without names that are more than seven may be anything.
    assert!(
        read("1,0,0,0,0,0,9.8,30,-5,40\n")
            .unwrap_err()
            .contains("seven numbers")
    );
    let swapped: String = rows(" ", SI)
        .lines()
        .map(|row| {
            let words: Vec<&str> = row.split(' ').collect();
            format!("7 {} {}\n", words[4..].join(" "), words[..4].join(" "))
        })
        .collect();
    assert_read(&format!(
        "number acc_x acc_y acc_z time gyro_x gyro_y gyro_z\n{swapped}"
    ));
}

#[test]
fn what_is_ambiguous_is_refused_with_what_to_write() {
    let message = read(&rows(" ", [1.0, 16.0, 1.0])).unwrap_err();
    assert!(
        message.contains("the unit of the angular rates"),
        "{message}"
    );
    assert!(message.contains("gyro_x_rad_s"), "{message}");
    let message = read(&rows(" ", [1.0, 1.0, 0.3])).unwrap_err();
    assert!(
        message.contains("the unit of the specific forces"),
        "{message}"
    );
    let message = read(&rows(" ", [1e12, 1.0, 1.0])).unwrap_err();
    assert!(message.contains("the unit of the times"), "{message}");
    let message = read(&format!("time,x,y,z\n{}", rows(",", SI))).unwrap_err();
    assert!(message.contains("the first row `time,x,y,z`"), "{message}");
    let message = read("0 1 2 3 4 5\n").unwrap_err();
    assert!(
        message.contains("line 1: 6 numbers where 7 are needed"),
        "{message}"
    );
    let message = read("0 1 2 3 4 5 x\n").unwrap_err();
    assert!(message.contains("`x` is not a finite number"), "{message}");
    assert!(read("").is_err());
}

#[test]
fn oxts_have_their_axes_and_times() {
    let folder = tempfile::tempdir().unwrap();
    let oxts = folder.path().join("oxts");
    fs::create_dir_all(oxts.join("data")).unwrap();
    fs::write(
        folder.path().join("calib_imu_to_velo.txt"),
        "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n",
    )
    .unwrap();
    let mut times = String::new();
    for row in 0..3 {
        let numbers: Vec<String> = (0..30)
            .map(|column| format!("{}", column + 100 * row))
            .collect();
        fs::write(oxts.join(format!("data/{row:010}.txt")), numbers.join(" ")).unwrap();
        times += &format!("2011-09-26 13:02:25.{row}\n");
    }
    fs::write(oxts.join("timestamps.txt"), times).unwrap();
    let samples = read_oxts(&oxts).unwrap();
    assert_eq!(samples.len(), 3);
    assert_eq!(samples[1].force_m_s2, Vector3::new(111.0, 112.0, 113.0));
    assert_eq!(samples[1].rate_rad_s, Vector3::new(117.0, 118.0, 119.0));
    assert_relative_eq!(samples[1].time_s - samples[0].time_s, 0.1, epsilon = 1e-6);
}
