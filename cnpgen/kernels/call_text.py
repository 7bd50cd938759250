"""LLVM IR that calls a kernel with NumPy arrays.

Shapes, strides and addresses come from Python's buffer protocol, in a quarter of the time
that Python code takes. The functions and the struct are those of Python's stable ABI.
"""

# The functions of Python's C API that the code calls.
PYTHON_FUNCTIONS = (
    "PyObject_GetBuffer", "PyBuffer_Release", "PyErr_Clear", "PyTuple_GetItem", "PyList_GetItem", "PyTuple_Size",
    "PyEval_SaveThread", "PyEval_RestoreThread",
)  # fmt: skip

# int call(const callee *k, void *arguments, void *results) runs a kernel on a tuple of
# arguments and a list of results; it returns 0 without running it if one of them is no
# float64 array of shape (width, n) with contiguous rows. A callee is {address of the kernel,
# number of inputs, number of outputs, widths}. A Py_buffer has 80 bytes: memory at 0,
# dimensions at 36, format at 40, shape at 48, strides at 56.
CALL = """
%buffer = type { ptr, ptr, i64, i64, i32, i32, ptr, ptr, ptr, ptr, ptr }
declare i32 @PyObject_GetBuffer(ptr, ptr, i32)
declare void @PyBuffer_Release(ptr)
declare void @PyErr_Clear()
declare ptr @PyTuple_GetItem(ptr, i64)
declare ptr @PyList_GetItem(ptr, i64)
declare i64 @PyTuple_Size(ptr)
declare ptr @PyEval_SaveThread()
declare void @PyEval_RestoreThread(ptr)

define i32 @call(ptr %k, ptr %arguments, ptr %results) {
entry:
  %kernel = load ptr, ptr %k
  %inputs_at = getelementptr i64, ptr %k, i64 1
  %inputs = load i64, ptr %inputs_at
  %outputs_at = getelementptr i64, ptr %k, i64 2
  %outputs = load i64, ptr %outputs_at
  %widths_at = getelementptr i64, ptr %k, i64 3
  %widths = load ptr, ptr %widths_at
  %count = add i64 %inputs, %outputs
  %buffers = alloca %buffer, i64 %count, align 8
  %numbers = alloca ptr, i64 %count, align 8
  %strides = alloca i64, i64 %count, align 8
  %size = call i64 @PyTuple_Size(ptr %arguments)
  %as_many = icmp eq i64 %size, %inputs
  br i1 %as_many, label %next, label %refuse_all
refuse_all:
  br label %release

next: ; array i; n is the number of lanes, known from array 0
  %i = phi i64 [0, %entry], [%i1, %fits]
  %n = phi i64 [0, %entry], [%lanes, %fits]
  %all = icmp eq i64 %i, %count
  br i1 %all, label %run, label %item
item:
  %is_input = icmp ult i64 %i, %inputs
  br i1 %is_input, label %argument, label %result
argument:
  %from_tuple = call ptr @PyTuple_GetItem(ptr %arguments, i64 %i)
  br label %open
result:
  %j = sub i64 %i, %inputs
  %from_list = call ptr @PyList_GetItem(ptr %results, i64 %j)
  br label %open
open:
  %object = phi ptr [%from_tuple, %argument], [%from_list, %result]
  %b = getelementptr %buffer, ptr %buffers, i64 %i
  %failed = call i32 @PyObject_GetBuffer(ptr %object, ptr %b, i32 28) ; PyBUF_STRIDES | PyBUF_FORMAT
  %i1 = add i64 %i, 1
  %opened = icmp eq i32 %failed, 0
  br i1 %opened, label %check, label %no_array
no_array:
  call void @PyErr_Clear()
  br label %release

check:
  %dimensions_at = getelementptr i8, ptr %b, i64 36
  %dimensions = load i32, ptr %dimensions_at
  %matrix = icmp eq i32 %dimensions, 2
  br i1 %matrix, label %shape, label %release
shape:
  %shape_at = getelementptr i8, ptr %b, i64 48
  %shapes = load ptr, ptr %shape_at
  %rows = load i64, ptr %shapes
  %columns_at = getelementptr i64, ptr %shapes, i64 1
  %columns = load i64, ptr %columns_at
  %first = icmp eq i64 %i, 0
  %lanes = select i1 %first, i64 %columns, i64 %n
  %same_lanes = icmp eq i64 %columns, %lanes
  %width_at = getelementptr i64, ptr %widths, i64 %i
  %width = load i64, ptr %width_at
  %same_width = icmp eq i64 %rows, %width
  %format_at = getelementptr i8, ptr %b, i64 40
  %format = load ptr, ptr %format_at
  %letter = load i8, ptr %format
  %native = icmp eq i8 %letter, 61 ; "="
  %offset = zext i1 %native to i64
  %kind_at = getelementptr i8, ptr %format, i64 %offset
  %kind = load i8, ptr %kind_at
  %double = icmp eq i8 %kind, 100 ; "d"
  %strides_at = getelementptr i8, ptr %b, i64 56
  %steps = load ptr, ptr %strides_at
  %row_step = load i64, ptr %steps
  %lane_step_at = getelementptr i64, ptr %steps, i64 1
  %lane_step = load i64, ptr %lane_step_at
  %packed = icmp eq i64 %lane_step, 8
  %single = icmp slt i64 %lanes, 2
  %contiguous = or i1 %packed, %single
  %a1 = and i1 %same_lanes, %same_width
  %a2 = and i1 %double, %contiguous
  %fit = and i1 %a1, %a2
  br i1 %fit, label %fits, label %release
fits:
  %memory = load ptr, ptr %b
  %number_at = getelementptr ptr, ptr %numbers, i64 %i
  store ptr %memory, ptr %number_at
  %stride = ashr i64 %row_step, 3
  %stride_at = getelementptr i64, ptr %strides, i64 %i
  store i64 %stride, ptr %stride_at
  br label %next

run:
  %empty = icmp eq i64 %n, 0
  br i1 %empty, label %release, label %evaluate
evaluate:
  %out = getelementptr ptr, ptr %numbers, i64 %inputs
  %thread = call ptr @PyEval_SaveThread()
  call void %kernel(i64 %n, ptr %numbers, ptr %strides, ptr %out)
  call void @PyEval_RestoreThread(ptr %thread)
  br label %release

release: ; the arrays that were opened
  %open_arrays = phi i64 [0, %refuse_all], [%i, %no_array], [%i1, %check], [%i1, %shape], [%count, %run], [%count, %evaluate]
  %answer = phi i32 [0, %refuse_all], [0, %no_array], [0, %check], [0, %shape], [1, %run], [1, %evaluate]
  br label %close
close:
  %left = phi i64 [%open_arrays, %release], [%one_less, %array]
  %none = icmp eq i64 %left, 0
  br i1 %none, label %end, label %array
array:
  %one_less = sub i64 %left, 1
  %last = getelementptr %buffer, ptr %buffers, i64 %one_less
  call void @PyBuffer_Release(ptr %last)
  br label %close
end:
  ret i32 %answer
}
"""
