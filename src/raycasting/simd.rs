//! Vector registers as lanes, and the instruction sets that provide them.
//!
//! The compiler vectorizes plain loops over arrays only where it recognizes them, which it does
//! not in the traversal of a single ray. A [`SimdTask`] is therefore written in lanes and compiled
//! once per instruction set; [`dispatch`] selects the best one of this CPU. Every operation is
//! rounded by itself, so that all instruction sets give the same bits.

use std::ops::{Add, Div, Index, Mul, Sub};

use glam::Vec4;

/// Lanes of an eight-wide register.
pub(super) const WIDTH: usize = 8;

/// Numbers on which operations work element by element.
pub(super) trait Lanes:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Mul<f32, Output = Self>
    + Div<Output = Self>
{
    type Array: Index<usize, Output = f32>;

    fn to_array(self) -> Self::Array;
    /// The smaller number of each lane; NaN if that of `other` is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger number of each lane; NaN if that of `other` is NaN.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    /// Bit mask of the lanes with `self <= other`, the first lane lowest.
    fn le(self, other: Self) -> u32;
    /// Bit mask of the lanes with `self < other`, the first lane lowest.
    fn lt(self, other: Self) -> u32;
}

/// An instruction set, as a proof that this CPU has it.
pub(super) trait Simd: Copy {
    type F32x8: Lanes<Array = [f32; WIDTH]>;

    fn load(self, numbers: [f32; WIDTH]) -> Self::F32x8;
    fn splat(self, number: f32) -> Self::F32x8;
    /// Whole numbers as floats.
    fn whole(self, numbers: [u16; WIDTH]) -> Self::F32x8;
}

/// Work that is compiled for each instruction set. All that it calls must be `inline(always)`.
pub(super) trait SimdTask {
    fn run<S: Simd>(self, simd: S);
}

/// Runs a task with the best instruction set of this CPU.
pub(super) fn dispatch(task: impl SimdTask) {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx2) = avx2::Avx2::detect() {
        return avx2.run(task);
    }
    task.run(Baseline);
}

impl Lanes for Vec4 {
    type Array = [f32; 4];

    #[inline(always)]
    fn to_array(self) -> [f32; 4] {
        Self::to_array(&self)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::min(self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::max(self, other)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::abs(self)
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        self.cmple(other).bitmask()
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        self.cmplt(other).bitmask()
    }
}

/// Implements operators of lanes by functions of two lanes.
macro_rules! operators {
    ($lanes:ty: $($operator:ident, $method:ident, $function:expr;)*) => {
        $(impl $operator for $lanes {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                $function(self, other)
            }
        })*
    };
}

/// The instructions that every CPU of the target has.
#[derive(Clone, Copy)]
pub(super) struct Baseline;

impl Simd for Baseline {
    type F32x8 = Vec4Pair;

    #[inline(always)]
    fn load(self, [a, b, c, d, e, f, g, h]: [f32; WIDTH]) -> Vec4Pair {
        Vec4Pair(Vec4::new(a, b, c, d), Vec4::new(e, f, g, h))
    }
    #[inline(always)]
    fn splat(self, number: f32) -> Vec4Pair {
        Vec4Pair(Vec4::splat(number), Vec4::splat(number))
    }
    #[inline(always)]
    fn whole(self, numbers: [u16; WIDTH]) -> Vec4Pair {
        self.load(numbers.map(f32::from))
    }
}

/// Eight lanes in two registers.
#[derive(Clone, Copy)]
pub(super) struct Vec4Pair(Vec4, Vec4);

impl Vec4Pair {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(Vec4, Vec4) -> Vec4) -> Self {
        Self(operation(self.0, other.0), operation(self.1, other.1))
    }
}

operators! { Vec4Pair:
    Add, add, |a: Self, b| a.zip(b, |a, b| a + b);
    Sub, sub, |a: Self, b| a.zip(b, |a, b| a - b);
    Mul, mul, |a: Self, b| a.zip(b, |a, b| a * b);
    Div, div, |a: Self, b| a.zip(b, |a, b| a / b);
}

impl Mul<f32> for Vec4Pair {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: f32) -> Self {
        Self(self.0 * factor, self.1 * factor)
    }
}

impl Lanes for Vec4Pair {
    type Array = [f32; WIDTH];

    #[inline(always)]
    fn to_array(self) -> [f32; WIDTH] {
        bytemuck::cast([self.0.to_array(), self.1.to_array()])
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, Vec4::min)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, Vec4::max)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.abs(), self.1.abs())
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        self.0.le(other.0) | self.1.le(other.1) << 4
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        self.0.lt(other.0) | self.1.lt(other.1) << 4
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    #![expect(unsafe_code, reason = "vector instructions exist only on some CPUs")]

    use std::arch::x86_64::*;
    use std::ops::{Add, Div, Mul, Sub};

    use super::{Lanes, Simd, SimdTask, WIDTH};

    /// Proof that this CPU has AVX2: only [`Avx2::detect`] makes one.
    #[derive(Clone, Copy)]
    pub struct Avx2(());

    impl Avx2 {
        pub fn detect() -> Option<Self> {
            is_x86_feature_detected!("avx2").then_some(Self(()))
        }

        /// Runs a task compiled for AVX2.
        pub fn run(self, task: impl SimdTask) {
            #[target_feature(enable = "avx2")]
            fn run_compiled(task: impl SimdTask, avx2: Avx2) {
                task.run(avx2);
            }
            // SAFETY: `self` proves that the CPU has AVX2.
            unsafe { run_compiled(task, self) }
        }
    }

    impl Simd for Avx2 {
        type F32x8 = F32x8;

        #[inline(always)]
        fn load(self, numbers: [f32; WIDTH]) -> F32x8 {
            F32x8(bytemuck::cast(numbers), self)
        }
        #[inline(always)]
        fn splat(self, number: f32) -> F32x8 {
            self.load([number; WIDTH])
        }
        #[inline(always)]
        fn whole(self, numbers: [u16; WIDTH]) -> F32x8 {
            let numbers = bytemuck::cast(numbers);
            // SAFETY: `self` proves that the CPU has AVX2.
            let lanes = unsafe { _mm256_cvtepi32_ps(_mm256_cvtepu16_epi32(numbers)) };
            F32x8(lanes, self)
        }
    }

    /// Eight lanes in one register, with the proof that there is such a register.
    #[derive(Clone, Copy)]
    pub struct F32x8(__m256, Avx2);

    /// An intrinsic of two registers as a function of lanes.
    macro_rules! intrinsic {
        ($name:ident) => {
            |a: F32x8, b: F32x8| {
                // SAFETY: `a` carries the proof that the CPU has AVX2.
                F32x8(unsafe { $name(a.0, b.0) }, a.1)
            }
        };
    }

    operators! { F32x8:
        Add, add, intrinsic!(_mm256_add_ps);
        Sub, sub, intrinsic!(_mm256_sub_ps);
        Mul, mul, intrinsic!(_mm256_mul_ps);
        Div, div, intrinsic!(_mm256_div_ps);
    }

    impl Mul<f32> for F32x8 {
        type Output = Self;
        #[inline(always)]
        fn mul(self, factor: f32) -> Self {
            self * self.1.splat(factor)
        }
    }

    impl Lanes for F32x8 {
        type Array = [f32; WIDTH];

        #[inline(always)]
        fn to_array(self) -> [f32; WIDTH] {
            bytemuck::cast(self.0)
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            intrinsic!(_mm256_min_ps)(self, other)
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            intrinsic!(_mm256_max_ps)(self, other)
        }
        #[inline(always)]
        fn abs(self) -> Self {
            intrinsic!(_mm256_andnot_ps)(self.1.splat(-0.0), self)
        }
        #[inline(always)]
        fn le(self, other: Self) -> u32 {
            // SAFETY: `self` carries the proof that the CPU has AVX2.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0)) as u32 }
        }
        #[inline(always)]
        fn lt(self, other: Self) -> u32 {
            // SAFETY: `self` carries the proof that the CPU has AVX2.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) as u32 }
        }
    }
}
