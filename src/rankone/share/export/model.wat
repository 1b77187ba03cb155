;; The loops of the JavaScript model in which its time is spent, two numbers at a time.
;;
;; The binary is part of `model_train.js.in`: wat2wasm model.wat, in base64. Positions are in bytes.
;; The sums are formed in the same order as in the loops in JavaScript, so that no bit differs.
(module
  (import "m" "h" (memory 1))

  ;; products of each number of a column and each value of a basis: (column, basis)
  (func (export "p")
    (param $basis i32) (param $count i32) (param $column i32) (param $right i32) (param $out i32)
    (local $k i32) (local $end i32) (local $value v128)
    (local.set $count (i32.shl (local.get $count) (i32.const 3)))
    (block $done
      (loop $each
        (br_if $done (i32.eqz (local.get $right)))
        (local.set $value (v128.load64_splat (local.get $column)))
        (local.set $k (local.get $basis))
        (local.set $end (i32.add (local.get $out) (local.get $count)))
        ;; of an odd count one more is written, over which the next ones go
        (loop $next
          (v128.store (local.get $out) (f64x2.mul (v128.load (local.get $k)) (local.get $value)))
          (local.set $k (i32.add (local.get $k) (i32.const 16)))
          (local.set $out (i32.add (local.get $out) (i32.const 16)))
          (br_if $next (i32.lt_u (local.get $out) (local.get $end))))
        (local.set $out (local.get $end))
        (local.set $column (i32.add (local.get $column) (i32.const 8)))
        (local.set $right (i32.sub (local.get $right) (i32.const 1)))
        (br $each))))

  ;; a core times such products: eight rows of a column at a time
  (func (export "c")
    (param $d i32) (param $run i32) (param $blocks i32) (param $right i32)
    (param $products i32) (param $count i32) (param $out i32)
    (local $k i32) (local $end i32) (local $w i32) (local $last i32) (local $value v128)
    (local $s0 v128) (local $s1 v128) (local $s2 v128) (local $s3 v128)
    (local.set $count (i32.shl (local.get $count) (i32.const 3)))
    (local.set $last
      (i32.add (local.get $products) (i32.mul (local.get $right) (local.get $count))))
    (block $done
      (loop $block
        (br_if $done (i32.eqz (local.get $blocks)))
        (local.set $s0 (v128.const i64x2 0 0))
        (local.set $s1 (v128.const i64x2 0 0))
        (local.set $s2 (v128.const i64x2 0 0))
        (local.set $s3 (v128.const i64x2 0 0))
        (local.set $w (local.get $products))
        (loop $each
          (local.set $k (local.get $w))
          (local.set $end
            (i32.add (local.get $w) (i32.shl (i32.load (local.get $run)) (i32.const 3))))
          (if (i32.lt_u (local.get $k) (local.get $end)) (then
            (loop $next
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
              (br_if $next (i32.lt_u (local.get $k) (local.get $end))))))
          (local.set $run (i32.add (local.get $run) (i32.const 4)))
          (local.set $w (i32.add (local.get $w) (local.get $count)))
          (br_if $each (i32.lt_u (local.get $w) (local.get $last))))
        (v128.store (local.get $out) (local.get $s0))
        (v128.store offset=16 (local.get $out) (local.get $s1))
        (v128.store offset=32 (local.get $out) (local.get $s2))
        (v128.store offset=48 (local.get $out) (local.get $s3))
        (local.set $out (i32.add (local.get $out) (i32.const 64)))
        (local.set $blocks (i32.sub (local.get $blocks) (i32.const 1)))
        (br $block))))

  ;; the matrix of a core for the values of a basis: eight entries at a time
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
        (if (i32.lt_u (local.get $k) (local.get $end)) (then
          (loop $next
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
            (br_if $next (i32.lt_u (local.get $k) (local.get $end))))))
        (v128.store (local.get $out) (local.get $s0))
        (v128.store offset=16 (local.get $out) (local.get $s1))
        (v128.store offset=32 (local.get $out) (local.get $s2))
        (v128.store offset=48 (local.get $out) (local.get $s3))
        (local.set $out (i32.add (local.get $out) (i32.const 64)))
        (local.set $run (i32.add (local.get $run) (i32.const 4)))
        (local.set $blocks (i32.sub (local.get $blocks) (i32.const 1)))
        (br $block))))

  ;; a row times such a matrix: eight rows of it at a time
  (func (export "r")
    (param $row i32) (param $at i32) (param $blocks i32) (param $right i32) (param $out i32)
    (local $k i32) (local $m i32) (local $stop i32) (local $stride i32) (local $last i32)
    (local $s0 v128) (local $s1 v128) (local $s2 v128) (local $s3 v128)
    (local.set $stride (i32.shl (local.get $right) (i32.const 6)))
    (local.set $last (i32.add (local.get $at) (local.get $stride)))
    (local.set $stop (i32.add (local.get $row) (i32.shl (local.get $blocks) (i32.const 6))))
    (loop $column
      (local.set $s0 (v128.const i64x2 0 0))
      (local.set $s1 (v128.const i64x2 0 0))
      (local.set $s2 (v128.const i64x2 0 0))
      (local.set $s3 (v128.const i64x2 0 0))
      (local.set $k (local.get $row))
      (local.set $m (local.get $at))
      (loop $next
        (local.set $s0 (f64x2.add (local.get $s0)
          (f64x2.mul (v128.load (local.get $k)) (v128.load (local.get $m)))))
        (local.set $s1 (f64x2.add (local.get $s1)
          (f64x2.mul (v128.load offset=16 (local.get $k)) (v128.load offset=16 (local.get $m)))))
        (local.set $s2 (f64x2.add (local.get $s2)
          (f64x2.mul (v128.load offset=32 (local.get $k)) (v128.load offset=32 (local.get $m)))))
        (local.set $s3 (f64x2.add (local.get $s3)
          (f64x2.mul (v128.load offset=48 (local.get $k)) (v128.load offset=48 (local.get $m)))))
        (local.set $m (i32.add (local.get $m) (local.get $stride)))
        (local.set $k (i32.add (local.get $k) (i32.const 64)))
        (br_if $next (i32.lt_u (local.get $k) (local.get $stop))))
      (local.set $s0 (f64x2.add (f64x2.add (local.get $s0) (local.get $s1))
        (f64x2.add (local.get $s2) (local.get $s3))))
      (f64.store (local.get $out)
        (f64.add (f64x2.extract_lane 0 (local.get $s0)) (f64x2.extract_lane 1 (local.get $s0))))
      (local.set $out (i32.add (local.get $out) (i32.const 8)))
      (local.set $at (i32.add (local.get $at) (i32.const 64)))
      (br_if $column (i32.lt_u (local.get $at) (local.get $last))))))
