/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
document.addEventListener('DOMContentLoaded', () => renderMathInElement(document.body, {
  delimiters: [{left: '\\(', right: '\\)', display: false},
               {left: '\\[', right: '\\]', display: true}]}));
