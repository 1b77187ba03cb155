;; The loops of the JavaScript model in which its time is spent, two numbers at a time.
;;
;; The binary is part of `model_train.js.in`: wat2wasm model.wat, in base64. Positions are in bytes.
;; The sums are formed in the same order as in the loops in JavaScript, so that no bit differs.
(module
  (import "m" "h" (memory 1))

  ;; eight entries of a matrix at a time
  (func (export "s")
    (param $d i32) (param $run i32) (param $blocks i32) (param $basis i32) (param $out i32)
    (local $k i32) (local $end i32) (local $value v128)
    (local $s0 v128) (local $s1 v128) (local $s2 v128) (local $s3 v128)
    (block $done
      (loop $block
        (br_if $done (i32.eqz (local.get $blocks)))
        (local.set $s0 (v128.const i64x2 0 0))
        (local.set $s1 (v128.const i64x2 0 0))
        (local.set $s2 (v128.const i64x2 0 0))
        (local.set $s3 (v128.const i64x2 0 0))
        (local.set $k (local.get $basis))
        (local.set $end
          (i32.add (local.get $basis) (i32.shl (i32.load (local.get $run)) (i32.const 3))))
        (block $stop
          (loop $next
            (br_if $stop (i32.ge_u (local.get $k) (local.get $end)))
            (local.set $value (v128.load64_splat (local.get $k)))
            (local.set $s0 (f64x2.add (local.get $s0)
              (f64x2.mul (v128.load (local.get $d)) (local.get $value))))
            (local.set $s1 (f64x2.add (local.get $s1)
              (f64x2.mul (v128.load offset=16 (local.get $d)) (local.get $value))))
            (local.set $s2 (f64x2.add (local.get $s2)
              (f64x2.mul (v128.load offset=32 (local.get $d)) (local.get $value))))
            (local.set $s3 (f64x2.add (local.get $s3)
              (f64x2.mul (v128.load offset=48 (local.get $d)) (local.get $value))))
            (local.set $d (i32.add (local.get $d) (i32.const 64)))
            (local.set $k (i32.add (local.get $k) (i32.const 8)))
            (br $next)))
        (v128.store (local.get $out) (local.get $s0))
        (v128.store offset=16 (local.get $out) (local.get $s1))
        (v128.store offset=32 (local.get $out) (local.get $s2))
        (v128.store offset=48 (local.get $out) (local.get $s3))
        (local.set $out (i32.add (local.get $out) (i32.const 64)))
        (local.set $run (i32.add (local.get $run) (i32.const 4)))
        (local.set $blocks (i32.sub (local.get $blocks) (i32.const 1)))
        (br $block))))

  ;; a matrix (right, stride) times a column; stride in bytes
  (func (export "t")
    (param $at i32) (param $column i32) (param $stride i32) (param $right i32) (param $out i32)
    (local $m i32) (local $c i32) (local $last i32) (local $stop i32) (local $s v128)
    (local.set $last (i32.add (local.get $at) (local.get $stride)))
    (local.set $stop
      (i32.add (local.get $column) (i32.shl (local.get $right) (i32.const 3))))
    (block $done
      (loop $row
        (br_if $done (i32.ge_u (local.get $at) (local.get $last)))
        (local.set $s (v128.const i64x2 0 0))
        (local.set $m (local.get $at))
        (local.set $c (local.get $column))
        (loop $next
          (local.set $s (f64x2.add (local.get $s)
            (f64x2.mul (v128.load (local.get $m)) (v128.load64_splat (local.get $c)))))
          (local.set $m (i32.add (local.get $m) (local.get $stride)))
          (local.set $c (i32.add (local.get $c) (i32.const 8)))
          (br_if $next (i32.lt_u (local.get $c) (local.get $stop))))
        (v128.store (local.get $out) (local.get $s))
        (local.set $out (i32.add (local.get $out) (i32.const 16)))
        (local.set $at (i32.add (local.get $at) (i32.const 16)))
        (br $row))))

  ;; a row times a matrix (right, stride); stride in bytes
  (func (export "r")
    (param $row i32) (param $at i32) (param $stride i32) (param $right i32) (param $out i32)
    (local $k i32) (local $stop i32) (local $s v128)
    (local.set $stop (i32.add (local.get $row) (local.get $stride)))
    (block $done
      (loop $column
        (br_if $done (i32.eqz (local.get $right)))
        (local.set $s (v128.const i64x2 0 0))
        (local.set $k (local.get $row))
        (loop $next
          (local.set $s (f64x2.add (local.get $s)
            (f64x2.mul (v128.load (local.get $k)) (v128.load (local.get $at)))))
          (local.set $at (i32.add (local.get $at) (i32.const 16)))
          (local.set $k (i32.add (local.get $k) (i32.const 16)))
          (br_if $next (i32.lt_u (local.get $k) (local.get $stop))))
        (f64.store (local.get $out)
          (f64.add (f64x2.extract_lane 0 (local.get $s)) (f64x2.extract_lane 1 (local.get $s))))
        (local.set $out (i32.add (local.get $out) (i32.const 8)))
        (local.set $right (i32.sub (local.get $right) (i32.const 1)))
        (br $column)))))
