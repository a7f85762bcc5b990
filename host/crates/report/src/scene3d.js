(function(){
var s=document.currentScript,box=s.parentNode,d=JSON.parse(box.querySelector('script[type="application/json"]').textContent);
var pic=box.querySelector('.still'),c=document.createElement('canvas'),g=c.getContext('2d');
if(!g)return;
var W=d.w,H=d.h,R=window.devicePixelRatio||1,az=d.az,el=d.el,zoom=1,ask=false;
c.style.cssText='width:'+W+'px;height:'+H+'px;max-width:100%;touch-action:none;cursor:grab';
c.width=W*R;c.height=H*R;c.tabIndex=0;c.setAttribute('role','img');c.setAttribute('aria-label',d.title);
var n=d.cols,m=d.rows,lut=[];
for(var i=0;i<d.lut.length;i+=6)lut.push([0,2,4].map(function(k){return parseInt(d.lut.substr(i+k,2),16)}));
function draw(){ask=false;
var ca=Math.cos(az),sa=Math.sin(az),ce=Math.cos(el),se=Math.sin(el),f=d.f*zoom;
function P(x,y,z){var u=x*ca-y*sa,v=x*sa+y*ca;return[W/2+u*f,H/2+(v*se-z*ce)*f,v*ce+z*se]}
g.setTransform(R,0,0,R,0,0);g.clearRect(0,0,W,H);
var ink=getComputedStyle(box).color,p=[],q=[],i,j;
for(j=0;j<m;j++)for(i=0;i<n;i++){var z=d.z[j*n+i];p.push(z===null?null:P((i/(n-1)-.5)*d.ax,(j/(m-1)-.5)*d.ay,(z-.5)*d.az3))}
g.strokeStyle=ink;g.fillStyle=ink;g.globalAlpha=.45;g.lineWidth=1;
var x=d.ax/2,y=d.ay/2,h=d.az3/2,b=[[-x,-y],[x,-y],[x,y],[-x,y]];
function L(a,b){g.beginPath();g.moveTo(a[0],a[1]);g.lineTo(b[0],b[1]);g.stroke()}
for(i=0;i<4;i++){var e=b[i],k=b[(i+1)%4];L(P(e[0],e[1],-h),P(k[0],k[1],-h));L(P(e[0],e[1],-h),P(e[0],e[1],h))}
g.globalAlpha=1;
for(j=0;j<m-1;j++)for(i=0;i<n-1;i++){var o=j*n+i,a=p[o],r=p[o+1],t=p[o+n+1],u=p[o+n];if(a&&r&&t&&u)q.push([a[2]+r[2]+t[2]+u[2],a,r,t,u,o])}
q.sort(function(a,b){return a[0]-b[0]});
q.forEach(function(k){var o=k[5],z=(d.c[o]+d.c[o+1]+d.c[o+n]+d.c[o+n+1])/4,l=lut[Math.max(0,Math.min(lut.length-1,Math.round(z*(lut.length-1))))];
var s=d.s[o];g.fillStyle=g.strokeStyle='rgb('+l.map(function(v){return Math.round(v*s)}).join()+')';
g.beginPath();g.moveTo(k[1][0],k[1][1]);for(var e=2;e<5;e++)g.lineTo(k[e][0],k[e][1]);g.closePath();g.fill();g.stroke()});
g.fillStyle=ink;g.font='12px system-ui,sans-serif';g.textAlign='center';
d.labels.forEach(function(l){var t=P(l[0],l[1],l[2]);g.fillText(l[3],t[0],t[1]+4)})}
function later(){if(!ask){ask=true;requestAnimationFrame(draw)}}
var last=null;
c.onpointerdown=function(e){last=[e.clientX,e.clientY];c.setPointerCapture(e.pointerId);c.style.cursor='grabbing'};
c.onpointermove=function(e){if(!last)return;az-=(e.clientX-last[0])*.008;el=Math.max(0,Math.min(Math.PI/2,el+(e.clientY-last[1])*.008));last=[e.clientX,e.clientY];later()};
c.onpointerup=c.onpointercancel=function(){last=null;c.style.cursor='grab'};
c.addEventListener('wheel',function(e){e.preventDefault();zoom=Math.max(.3,Math.min(8,zoom*Math.exp(-e.deltaY*.0012)));later()},{passive:false});
c.ondblclick=function(){az=d.az;el=d.el;zoom=1;later()};
c.onkeydown=function(e){var k={ArrowLeft:[-.1,0],ArrowRight:[.1,0],ArrowUp:[0,-.1],ArrowDown:[0,.1]}[e.key];if(!k)return;e.preventDefault();az+=k[0];el=Math.max(0,Math.min(Math.PI/2,el+k[1]));later()};
draw();box.insertBefore(c,pic);pic.classList.add('print-only');
if(window.matchMedia)matchMedia('(prefers-color-scheme: dark)').addEventListener('change',later);
})();
